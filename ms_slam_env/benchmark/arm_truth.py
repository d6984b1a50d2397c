"""How near an arm really is to furniture and to itself: slow and exact, to judge fast answers by.

Nothing here is shared with the planner: furniture is a dense cloud of points of the true surface
instead of a grid of distances, links are MuJoCo's geoms instead of bounding capsules.
"""

from __future__ import annotations

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env.benchmark.arm_mesh import solid_of
from ms_slam_env.geometry import transform_points
from ms_slam_env.robot.arm import ArmModel
from ms_slam_env.scenes import Scene

Float64 = NDArray[np.float64]

FAR_M = 0.15
"""Gaps are exact up to this; what is farther away counts as this far."""

_SURFACE_SPACING_M = 0.005  # a gap of 2 cm comes out at most 0.3 mm too large
_AXIS_SPACING_M = 0.01  # of balls along the axis of a capsule
_FLAT_SPACING_M = 0.006  # of points on boxes, cylinders and the like
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_SPHERE))


class Furniture:
    """The true surface of a scene as a searchable cloud of points."""

    def __init__(self, scene: Scene) -> None:
        points, _ = scene.surface_points(_SURFACE_SPACING_M)
        self._tree = cKDTree(points)

    def distance(self, points: Float64) -> Float64:
        """Distance (N,) of points (N, 3) to the surface, at most ``FAR_M``."""
        found, _ = self._tree.query(points, distance_upper_bound=FAR_M)
        return np.minimum(found, FAR_M)


class ArmTruth:
    """Judges postures of an arm on its base by its colliding geoms; the base itself is left out.

    Args:
        model: the arm.
        furniture: around it.
        T_world_base: (4, 4) where it stands.
        column: radius and depth below the base, metres, of the column it stands on; None without.
    """

    def __init__(
        self,
        model: ArmModel,
        furniture: Furniture,
        T_world_base: Float64,
        column: tuple[float, float] | None = None,
    ) -> None:
        self._mj, self._qpos = model.mj, model.qpos
        self._furniture = furniture
        self._T_world_base = np.array(T_world_base, dtype=np.float64)
        self._column = column
        self._data = mujoco.MjData(model.mj)
        moved = set(_bodies_below(model.mj, model.mj.jnt_bodyid[0]))
        geoms = [
            geom
            for geom in range(model.mj.ngeom)
            if model.mj.geom_bodyid[geom] in moved
            and (model.mj.geom_contype[geom] or model.mj.geom_conaffinity[geom])
        ]
        self._geoms = np.array(geoms)
        sampled = [_samples(model.mj, geom) for geom in geoms]
        self._index = np.repeat(np.arange(len(geoms)), [len(points) for points, _ in sampled])
        self._points = np.concatenate([points for points, _ in sampled])
        self._radius = np.concatenate([np.full(len(p), r) for p, r in sampled])

    def gaps(self, q: Float64) -> Float64:
        """Smallest gap (k,) between moving links and furniture at joint angles (k, n), metres.

        Negative by less than a link's radius where they touch. For shapes other than capsules and
        balls it is up to 3 mm too small.
        """
        result = np.empty(len(q))
        for i, one in enumerate(q):
            points = transform_points(self._T_world_base, self._place(one))
            centres = self._data.geom_xpos[self._geoms]
            world = transform_points(self._T_world_base, centres)
            at_least = self._furniture.distance(world) - self._mj.geom_rbound[self._geoms]
            gap = FAR_M
            for geom in np.argsort(at_least):
                if at_least[geom] >= gap:
                    break
                own = self._index == geom
                gap = min(gap, (self._furniture.distance(points[own]) - self._radius[own]).min())
            result[i] = gap
        return result

    def touches_itself(self, q: Float64) -> NDArray[np.bool_]:
        """(k,) whether links touch each other or the column at joint angles (k, n)."""
        result = np.zeros(len(q), dtype=bool)
        for index, one in enumerate(q):
            points = self._place(one)
            mujoco.mj_collision(self._mj, self._data)
            contacts = self._data.contact.dist[: self._data.ncon]
            result[index] = bool((contacts < 0).any()) or self._touches_column(points)
        return result

    def _touches_column(self, points: Float64) -> bool:
        if self._column is None:
            return False
        radius, depth = self._column
        nearest = np.clip(points[:, 2], -depth, -radius)
        gap = np.hypot(np.hypot(points[:, 0], points[:, 1]), points[:, 2] - nearest) - radius
        return bool((gap < self._radius).any())

    def _place(self, q: Float64) -> Float64:
        """Sample points (N, 3) in the base's frame."""
        self._data.qpos[:] = self._mj.qpos0
        self._data.qpos[self._qpos] = q
        mujoco.mj_kinematics(self._mj, self._data)
        geom = self._geoms[self._index]
        R = self._data.geom_xmat.reshape(-1, 3, 3)[geom]
        return np.einsum("nij,nj->ni", R, self._points) + self._data.geom_xpos[geom]


def _bodies_below(mj: mujoco.MjModel, top: int) -> list[int]:
    found = [int(top)]
    for body in range(int(top) + 1, mj.nbody):  # parents come first
        if int(mj.body_parentid[body]) in found:
            found.append(body)
    return found


def _samples(mj: mujoco.MjModel, geom: int) -> tuple[Float64, float]:
    """Points (N, 3) in a geom's frame and a radius; balls around them cover the geom's surface."""
    kind, size = int(mj.geom_type[geom]), mj.geom_size[geom]
    if kind in _ROUND:
        half = float(size[1]) if kind == _ROUND[0] else 0.0
        count = int(np.ceil(2 * half / _AXIS_SPACING_M)) + 1
        points = np.zeros((count, 3))
        points[:, 2] = np.linspace(-half, half, count)
        return points, float(size[0])
    solid = solid_of(mj, geom)
    vertices, _ = trimesh.remesh.subdivide_to_size(solid.vertices, solid.faces, _FLAT_SPACING_M)
    return np.unique(np.round(vertices, 6), axis=0), 0.5 * _FLAT_SPACING_M
