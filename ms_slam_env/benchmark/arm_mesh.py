"""The triangles of an arm, to be seen in a scene without OpenGL."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import make_pose
from ms_slam_env.robot.arm.shape import Part
from ms_slam_env.scenes import Scene, TexturedMesh
from ms_slam_env.sensor import RGBDSensor

Float64 = NDArray[np.float64]

LABEL = "arm"
_AMBIENT, _DIRECT, _SECOND = 0.35, 0.65, 0.25
_TO_LIGHT = np.array([0.35, -0.3, 0.89])  # a ceiling lamp somewhat to the side
_TO_SECOND = np.array([-0.8, 0.55, 0.25])  # and light from the walls
_BRIGHTNESS = 0.9  # a white surface that faces the light, in units of the sensor's white


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
