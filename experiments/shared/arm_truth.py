"""How near an arm really is to furniture and to itself: slow and exact, to judge fast answers by.

Nothing here is shared with the planner: furniture is a dense cloud of points of the true surface
instead of a grid of distances, links are MuJoCo's geoms instead of bounding capsules.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, make_pose, transform_points
from ms_slam_env.robot.arm import ArmModel
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import RGBDSensor

FAR_M = 0.1
"""Gaps are exact up to this; what is farther away counts as this far."""

_SPACING_M = 0.005  # of a cloud's points: a gap of 2 cm comes out at most 0.3 mm too large
_CELL_M = 0.04  # of the coarse cloud
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_BALL = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)


class Cloud:
    """Points (N, 3) of a surface, to be found by place."""

    def __init__(self, points: Float64) -> None:
        self._points = np.asarray(points, dtype=np.float64)
        self._tree = cKDTree(self._points)
        cells = np.unique(np.floor(self._points / _CELL_M).astype(np.int64), axis=0)
        self._coarse = cKDTree((cells + 0.5) * _CELL_M)

    def at_least(self, places: Float64) -> Float64:
        """A lower bound (n,) of the distance between places (n, 3) and the surface."""
        return np.asarray(self._coarse.query(places)[0] - 0.5 * np.sqrt(3) * _CELL_M)

    def around(self, place: Float64, radius: float) -> Float64:
        """The points (k, 3) within ``radius`` of a place (3,)."""
        return self._points[self._tree.query_ball_point(place, radius)]


def furniture_cloud(scene: Scene, spacing_m: float = _SPACING_M) -> Cloud:
    """The true surface of a scene."""
    return Cloud(scene.surface_points(spacing_m)[0])


def floor_below(scene: Scene, point: Float64) -> float:
    """Height of the surface under a point (3,); the point's own where there is none."""
    camera = Intrinsics(fx=1, fy=1, cx=0, cy=0, width=1, height=1)
    start = point + np.array([0, 0, 0.01])
    down = make_pose(np.diag([1.0, -1.0, -1.0]), start)
    depth = float(RGBDSensor(scene, camera, noise="none").ground_truth(down).depth[0, 0])
    return float(start[2] - depth) if depth > 0 else float(point[2])


def column_cloud(radius: float, depth: float) -> Cloud:
    """The column under an arm's base at the origin: round top at the base's plane, to a depth."""
    angles = np.arange(0, 2 * np.pi, _SPACING_M / radius)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    tilts = np.arange(0, np.pi / 2, _SPACING_M / radius)
    dome = [radius * (np.sin(t) * ring + [0, 0, np.cos(t) - 1]) for t in tilts]
    wall = [radius * ring + [0, 0, z] for z in np.arange(-radius, -depth, -_SPACING_M)]
    return Cloud(np.concatenate(dome + wall))


class ArmTruth:
    """Judges postures of an arm on its base by its colliding geoms; the base itself is left out.

    Args:
        model: the arm.
        furniture: around it, in the world.
        T_world_base: (4, 4) where it stands.
        column: under it, in the frame of the base; None without.
    """

    def __init__(
        self, model: ArmModel, furniture: Cloud, T_world_base: Float64, column: Cloud | None = None
    ) -> None:
        self._mj, self._qpos, self._camera_site = model.mj, model.qpos, model.camera_site
        self._furniture, self._column = furniture, column
        self._T_world_base = np.array(T_world_base, dtype=np.float64)
        self._data = mujoco.MjData(model.mj)
        moved = set(_bodies_below(model.mj, int(model.mj.jnt_bodyid[0])))
        self._geoms = [
            geom
            for geom in range(model.mj.ngeom)
            if int(model.mj.geom_bodyid[geom]) in moved
            and (model.mj.geom_contype[geom] or model.mj.geom_conaffinity[geom])
        ]

    def gaps(self, q: Float64) -> Float64:
        """Smallest gap (k,) between moving links and furniture at joint angles (k, n), metres.

        Not positive where they touch.
        """
        result = np.empty(len(q))
        for i, one in enumerate(q):
            self._place(one)
            result[i] = self._gap(self._furniture, self._T_world_base)
        return result

    def touches_itself(self, q: Float64) -> NDArray[np.bool_]:
        """(k,) whether links touch each other or the column at joint angles (k, n)."""
        result = np.zeros(len(q), dtype=bool)
        for i, one in enumerate(q):
            self._place(one)
            mujoco.mj_collision(self._mj, self._data)
            result[i] = (self._data.contact.dist[: self._data.ncon] < 0).any()
            if self._column is not None and not result[i]:
                result[i] = self._gap(self._column, np.eye(4)) <= 0
        return result

    def sees_itself(self, q: Float64, rays: Float64) -> bool:
        """Whether the arm is in its own camera's view at joint angles (n,).

        Args:
            q: joint angles.
            rays: (r, 3) directions in the camera's frame.
        """
        self._place(q)
        data, mj, site = self._data, self._mj, self._camera_site
        directions = rays @ data.site_xmat[site].reshape(3, 3).T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        body, geom = int(mj.site_bodyid[site]), np.zeros(1, dtype=np.int32)
        return any(
            mujoco.mj_ray(mj, data, data.site_xpos[site], ray, None, 1, body, geom) >= 0
            for ray in directions
        )

    def _gap(self, cloud: Cloud, T_cloud_base: Float64) -> float:
        data, mj = self._data, self._mj
        centres = transform_points(T_cloud_base, data.geom_xpos[self._geoms])
        reach = mj.geom_rbound[self._geoms]
        at_least = cloud.at_least(centres) - reach
        gap = FAR_M
        for k in np.argsort(at_least):
            if at_least[k] >= gap:
                break
            near = cloud.around(centres[k], reach[k] + gap)
            if len(near) == 0:
                continue
            geom = self._geoms[k]
            T_base_geom = np.eye(4)
            T_base_geom[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
            T_base_geom[:3, 3] = data.geom_xpos[geom]
            local = transform_points(invert(T_cloud_base @ T_base_geom), near)
            gap = min(gap, float(signed_distance(mj, geom, local).min()))
        return gap

    def _place(self, q: Float64) -> None:
        self._data.qpos[:] = self._mj.qpos0
        self._data.qpos[self._qpos] = q
        mujoco.mj_kinematics(self._mj, self._data)


def signed_distance(mj: mujoco.MjModel, geom: int, points: Float64) -> Float64:
    """Distance (N,) from points (N, 3) of a geom's frame to its surface, negative inside.

    Exact for balls, capsules, cylinders and boxes; for ellipsoids only near them; meshes by their
    bounding box.
    """
    kind, size = int(mj.geom_type[geom]), mj.geom_size[geom]
    if kind == _BALL:
        return np.asarray(np.linalg.norm(points, axis=1) - size[0])
    if kind == _CAPSULE:
        beyond = points.copy()
        beyond[:, 2] -= np.clip(points[:, 2], -size[1], size[1])
        return np.asarray(np.linalg.norm(beyond, axis=1) - size[0])
    if kind == _ELLIPSOID:
        scaled = np.linalg.norm(points / size, axis=1)
        slope = np.linalg.norm(points / size**2, axis=1)
        return np.asarray(scaled * (scaled - 1) / np.maximum(slope, 1e-12))
    if kind == _CYLINDER:
        across = np.hypot(points[:, 0], points[:, 1]) - size[0]
        outside = np.stack([across, np.abs(points[:, 2]) - size[1]], axis=1)
    else:
        box = mj.geom_aabb[geom]
        outside = np.abs(points - box[:3]) - box[3:]
    away = np.linalg.norm(np.maximum(outside, 0), axis=1)
    return np.asarray(away + np.minimum(outside.max(axis=1), 0))


def _bodies_below(mj: mujoco.MjModel, top: int) -> list[int]:
    found = [top]
    for body in range(top + 1, mj.nbody):  # parents come first
        if int(mj.body_parentid[body]) in found:
            found.append(body)
    return found
