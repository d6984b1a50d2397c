"""The visible surface of an arm: its geoms as coloured triangles, and the column it stands on."""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import mujoco
import numpy as np
import trimesh

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.robot.arm.base_placement import COLUMN_RADIUS_M
from ms_slam_env.robot.arm.model import ArmModel

_COLUMN_RGB = (0.62, 0.63, 0.65)
_FOOT_HEIGHT_M = 0.02
_SLENDER = 0.6  # radius of the drawn column, as a share of the one kept free
_SECTIONS = 48


@dataclasses.dataclass(frozen=True)
class Part:
    """One coloured solid in the world.

    Attributes:
        corners: (F, 3, 3) metres, counter-clockwise seen from outside.
        normals: (F, 3, 3) unit vectors at the corners.
        rgb: sRGB colour in [0, 1].
    """

    corners: Float64
    normals: Float64
    rgb: tuple[float, float, float]


def arm_parts(model: ArmModel, q: Float64, T_world_base: Float64) -> list[Part]:
    """Every geom of an arm, visual ones included, at joint angles (n,)."""
    data = mujoco.MjData(model.mj)
    data.qpos[:] = model.mj.qpos0
    data.qpos[model.qpos] = q
    mujoco.mj_kinematics(model.mj, data)
    parts = []
    for geom, part in _geoms(model):
        R = T_world_base[:3, :3] @ data.geom_xmat[geom].reshape(3, 3)
        t = T_world_base[:3, :3] @ data.geom_xpos[geom] + T_world_base[:3, 3]
        parts.append(Part(part.corners @ R.T + t, part.normals @ R.T, part.rgb))
    return parts


@lru_cache(maxsize=8)
def _geoms(model: ArmModel) -> list[tuple[int, Part]]:
    """Index and surface, in its own frame, of every visible geom."""
    mj = model.mj
    found = []
    for geom in range(mj.ngeom):
        rgba = mj.geom_rgba[geom]
        if mj.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE or rgba[3] == 0:
            continue
        r, g, b = map(float, rgba[:3])
        found.append((geom, _part(_solid(mj, geom), np.eye(4), (r, g, b))))
    return found


def surface_dots(parts: list[Part], spacing_m: float) -> tuple[Float64, Float64, Float64]:
    """Points (N, 3) on some parts, about ``spacing_m`` apart, with normals and colours (N, 3)."""
    points, normals, colours = [], [], []
    for part in parts:
        a, b, c = np.moveaxis(part.corners, 1, 0)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        reached = np.cumsum(area)
        count = int(np.ceil(reached[-1] / spacing_m**2))
        face = np.searchsorted(reached, (np.arange(count) + 0.5) * reached[-1] / count)
        # Halton sequence: even, without a pattern, and reproducible
        u, v = (_halton(count, base) for base in (2, 3))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
        points.append((weights * part.corners[face]).sum(axis=1))
        normals.append((weights * part.normals[face]).sum(axis=1))
        colours.append(np.tile(part.rgb, (count, 1)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(colours)


def _halton(count: int, base: int) -> Float64:
    """The first numbers (count,) of the van der Corput sequence in a base."""
    index, value, share = np.arange(1, count + 1), np.zeros(count), 1.0
    while index.any():
        share /= base
        index, digit = np.divmod(index, base)
        value += share * digit
    return value


def column_parts(base: Float64, floor_z: float) -> list[Part]:
    """A round column with a foot from the floor up to the arm's base at (3,)."""
    height = float(base[2]) - floor_z
    if height < _FOOT_HEIGHT_M:
        return []
    parts = []
    for radius, length in ((_SLENDER * COLUMN_RADIUS_M, height), (COLUMN_RADIUS_M, _FOOT_HEIGHT_M)):
        solid = trimesh.creation.cylinder(radius=radius, height=length, sections=_SECTIONS)
        T = np.eye(4)
        T[:3, 3] = [base[0], base[1], floor_z + 0.5 * length]
        parts.append(_part(solid, T, _COLUMN_RGB))
    return parts


def _solid(mj: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """A geom's surface in its own frame."""
    kind, size = int(mj.geom_type[geom]), mj.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == types.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=_SECTIONS)
    if kind == types.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(
            height=2 * size[1], radius=size[0], count=(_SECTIONS, _SECTIONS)
        )
    if kind == types.mjGEOM_MESH:
        mesh = mj.geom_dataid[geom]
        vertices = mj.mesh_vert[mj.mesh_vertadr[mesh] :][: mj.mesh_vertnum[mesh]]
        faces = mj.mesh_face[mj.mesh_faceadr[mesh] :][: mj.mesh_facenum[mesh]]
        return trimesh.Trimesh(vertices, faces, process=False)
    ball = trimesh.creation.icosphere(subdivisions=3)
    return ball.apply_scale(size if kind == types.mjGEOM_ELLIPSOID else np.full(3, size[0]))


def _part(solid: trimesh.Trimesh, T_world_solid: Float64, rgb: tuple[float, float, float]) -> Part:
    """A solid placed in the world, shaded smoothly except across sharp edges."""
    smooth = trimesh.graph.smooth_shade(solid, angle=np.radians(40))
    smooth.apply_transform(T_world_solid)
    corners = np.asarray(smooth.triangles, dtype=np.float64)
    normals = np.asarray(smooth.vertex_normals, dtype=np.float64)[smooth.faces]
    return Part(corners, normals, rgb)
