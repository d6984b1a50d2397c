"""The picture of the arm: `python -m ms_slam_experiments.pictures.arm`.

The arm where an episode put it in several scenes, seen from outside by the project's own renderer,
and what its camera sees. No OpenGL is needed.
"""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.pictures.drawing import Image, run_script, shrunk, titled_row
from ms_slam_experiments.shared.arm_truth import floor_below
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.env.config import EnvConfig
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.robot.arm.arm import KinematicArm
from ms_slam_env.robot.arm.shape import Part, arm_parts, column_parts
from ms_slam_env.scenes import Scene, TexturedMesh
from ms_slam_env.sensor import RGBDSensor

_FILL = 1.25  # distance of the near view in diagonals of the box around the arm
_FARTHER_M = 0.9  # the far view
_AZIMUTHS, _HEIGHTS = 24, (0.15, 0.45, 0.75)  # of the viewpoints tried; heights per distance
_WALL_GAP_M = 0.15  # that a viewpoint keeps from everything
_SMOOTH = 2  # pixels rendered for one shown, each way
_SEED = 1000
_SEEDS = {"table": 1003, "wall": 1002, "carpet": 1004}  # elsewhere the camera sees one flat colour
_GAZE_M = 1.0  # the far view shows what the camera looks at, up to there
_HIDDEN_M = 0.1  # nearer than this to what hides it, a point is still called seen
_START_TRIES = 20

LABEL = "arm"
_AMBIENT, _DIRECT, _SECOND = 0.35, 0.65, 0.25
_TO_LIGHT = np.array([0.35, -0.3, 0.89])  # a ceiling lamp somewhat to the side
_TO_SECOND = np.array([-0.8, 0.55, 0.25])  # and light from the walls
_BRIGHTNESS = 0.9  # a white surface that faces the light, in units of the sensor's white


@dataclass(frozen=True)
class Options(Checked):
    """Draw the arm in scenes, and what its camera sees."""

    scenes: tuple[str, ...] = ("table", "wall", "carpet", "living_room")
    """One row a scene."""
    seed: int | None = bounded(None, 0, 2**31)
    """Of scene, start pose and motions; None for one of which each scene shows what it is about."""
    moves: int = bounded(3, 0, 1000)
    """Random motions between start and picture."""
    width: int = bounded(320, 16, 4096)
    """Of one image, pixels."""
    arm: ArmConfig = field(default_factory=ArmConfig)
    """The arm."""
    out: Path = Path("docs/pictures/arm.png")
    """The PNG file to write."""


def arm_in(scene: Scene, config: ArmConfig, moves: int, seed: int) -> KinematicArm:
    """An arm at a drawn start pose of a scene, after some random motions."""
    rng = np.random.default_rng(seed)
    arm = KinematicArm(scene, config, EnvConfig.step_m, EnvConfig.step_rad, Timings())
    for _ in range(_START_TRIES):
        try:
            arm.reset(scene.sample_start(rng), rng)
            break
        except UnreachableError:
            continue
    else:
        raise UnreachableError(f"scene {scene.name!r}: no start pose that the arm can hold")
    for _ in range(moves):
        arm.move(int(rng.choice(np.flatnonzero(arm.action_masks()))))
    return arm


def pictures(scene: Scene, arm: KinematicArm, width: int) -> tuple[Image, Image, Image]:
    """The arm from afar and near, and the view of its camera, each (3/4 width, width, 3)."""
    base = arm.T_world_base[:3, 3]
    parts = arm_parts(arm.model, arm.q, arm.T_world_base)
    shown = scene_with(scene, parts + column_parts(base, floor_below(scene, base)))
    corners = np.concatenate([part.corners.reshape(-1, 3) for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    near = _FILL * float(np.linalg.norm(high - low))
    camera = RGBDSensor(scene, xtion("640x480"), noise="none").ground_truth(arm.T_world_camera)
    ahead = float(camera.depth[camera.depth.shape[0] // 2, camera.depth.shape[1] // 2])
    ahead = min(ahead, _GAZE_M) if ahead > 0 else _GAZE_M
    gaze = transform_points(arm.T_world_camera, np.array([[0, 0, ahead]]))[0]
    middle = 0.5 * (low + high)
    afar = 0.5 * (np.minimum(low, gaze) + np.maximum(high, gaze))
    return (
        _view(scene, shown, afar, near + _FARTHER_M, width, gaze),
        _view(scene, shown, middle, near, width, None),
        shrunk(camera.color, width),
    )


def _view(
    scene: Scene, shown: Scene, target: Float64, distance: float, width: int, also: Float64 | None
) -> Image:
    """Around ``target`` (3,), from the side that shows most of the arm, and ``also`` a point."""
    angles = np.linspace(0, 2 * np.pi, _AZIMUTHS, endpoint=False)
    offsets = np.array([(np.cos(a), np.sin(a), h) for h in _HEIGHTS for a in angles])
    offsets *= distance / np.linalg.norm(offsets, axis=1, keepdims=True)
    places = target + offsets
    places = places[scene.clearance(places) > _WALL_GAP_M]
    if len(places) == 0:
        raise InputError(f"scene {scene.name!r} has no room to look at the arm from outside")
    poses = [look_at(place, target) for place in places]
    sensor = RGBDSensor(shown, _outside_camera(80), noise="none")
    arm = shown.mesh.labels.index(LABEL)

    def shows(pose: Float64) -> tuple[bool, int]:
        view = sensor.ground_truth(pose)
        other = also is not None and _is_seen(also, pose, sensor.intrinsics, view.depth)
        return other, int((view.labels == arm).sum())

    best = max(poses, key=shows)
    large = RGBDSensor(shown, _outside_camera(_SMOOTH * width), noise="none").ground_truth(best)
    return shrunk(large.color, width)


def _is_seen(point: Float64, pose: Float64, camera: Intrinsics, depth: NDArray[Any]) -> bool:
    """Whether nothing hides a point (3,), well inside the picture, from a camera at ``pose``."""
    local = transform_points(invert(pose), point[None])
    if local[0, 2] <= 0:
        return False
    u, v = np.rint(camera.project(local)[0]).astype(int)
    height, width = camera.shape
    inside = width // 8 <= u < width - width // 8 and height // 8 <= v < height - height // 8
    return bool(inside and depth[v, u] > local[0, 2] - _HIDDEN_M)


def _outside_camera(width: int) -> Intrinsics:
    height = 3 * width // 4
    return Intrinsics(width, width, (width - 1) / 2, (height - 1) / 2, width, height)


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


def arm_sheet(options: Options) -> Image:
    """The whole sheet, an RGB image, one row a scene."""
    rows = []
    for name in options.scenes:
        seed = _SEEDS.get(name, _SEED) if options.seed is None else options.seed
        scene = scenes.make(name, seed)
        images = pictures(scene, arm_in(scene, options.arm, options.moves, seed), options.width)
        title = f"{name}, seed {seed}: from afar, from near, what the arm's camera sees"
        rows.append(titled_row(images, title))
    return np.concatenate(rows, 0)


if __name__ == "__main__":
    sys.exit(run_script(Options, arm_sheet))
