"""The triangles of an arm, to be seen in a scene without OpenGL."""

from __future__ import annotations

import copy
import dataclasses

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import make_pose
from ms_slam_env.robot.arm import ArmModel
from ms_slam_env.robot.arm.placement import COLUMN_RADIUS_M
from ms_slam_env.scenes import Scene, TexturedMesh
from ms_slam_env.sensor import RGBDSensor

Float64 = NDArray[np.float64]

LABEL = "arm"
_COLUMN_RGB = (0.62, 0.63, 0.65)
_FOOT_HEIGHT_M = 0.02
_SLENDER = 0.6  # radius of the column drawn, in units of the one that is kept free
_SECTIONS = 48
_AMBIENT, _DIRECT, _SECOND = 0.35, 0.65, 0.25
_TO_LIGHT = np.array([0.35, -0.3, 0.89])  # a ceiling lamp somewhat to the side
_TO_SECOND = np.array([-0.8, 0.55, 0.25])  # and light from the walls
_BRIGHTNESS = 0.9  # a white surface that faces the light, in units of the sensor's white


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
    mj = model.mj
    data = mujoco.MjData(mj)
    data.qpos[:] = mj.qpos0
    data.qpos[model.qpos] = q
    mujoco.mj_kinematics(mj, data)
    parts = []
    for geom in range(mj.ngeom):
        rgba = mj.geom_rgba[geom]
        if mj.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE or rgba[3] == 0:
            continue
        T_base_geom = np.eye(4)
        T_base_geom[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
        T_base_geom[:3, 3] = data.geom_xpos[geom]
        r, g, b = map(float, rgba[:3])
        parts.append(_part(_solid(mj, geom), T_world_base @ T_base_geom, (r, g, b)))
    return parts


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


def floor_below(scene: Scene, point: Float64) -> float:
    """Height of the surface under a point (3,); the point's own where there is none."""
    camera = Intrinsics(fx=1, fy=1, cx=0, cy=0, width=1, height=1)
    start = point + np.array([0, 0, 0.01])
    down = make_pose(np.diag([1.0, -1.0, -1.0]), start)
    depth = float(RGBDSensor(scene, camera, noise="none").ground_truth(down).depth[0, 0])
    return float(start[2] - depth) if depth > 0 else float(point[2])


def scene_with(scene: Scene, parts: list[Part]) -> Scene:
    """A copy of ``scene`` that shows ``parts`` too; they cast no shadow.

    The light on them is made up: a lamp above, light from the side, and a share from everywhere.
    """
    corners = np.concatenate([part.corners for part in parts])
    normals = np.concatenate([part.normals for part in parts])
    counts = [len(part.corners) for part in parts]
    light = _AMBIENT + sum(
        strength * np.clip(normals @ (to / np.linalg.norm(to)), 0, None)
        for strength, to in ((_DIRECT, _TO_LIGHT), (_SECOND, _TO_SECOND))
    )
    mesh = scene.mesh
    count = len(corners)
    faces = np.arange(3 * count, dtype=np.int32).reshape(count, 3) + len(mesh.vertices)
    light = np.repeat(np.asarray(light)[..., None], 3, axis=2) * _BRIGHTNESS / scene.exposure
    textures = [
        np.full((4, 4, 3), np.rint(255 * np.array(part.rgb)), dtype=np.uint8) for part in parts
    ]
    seen = copy.copy(scene)
    seen.mesh = TexturedMesh(
        vertices=np.concatenate([mesh.vertices, corners.reshape(-1, 3).astype(np.float32)]),
        faces=np.concatenate([mesh.faces, faces]),
        uv=np.concatenate([mesh.uv, np.full((count, 3, 2), 0.5, np.float32)]),
        face_texture=np.concatenate(
            [
                mesh.face_texture,
                np.repeat(len(mesh.textures) + np.arange(len(parts)), counts).astype(np.int32),
            ]
        ),
        face_label=np.concatenate(
            [mesh.face_label, np.full(count, len(mesh.labels), dtype=np.int32)]
        ),
        irradiance=np.concatenate([mesh.irradiance, light.astype(np.float32)]),
        textures=(*mesh.textures, *textures),
        labels=(*mesh.labels, LABEL),
    )
    return seen


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
