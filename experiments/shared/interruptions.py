"""Seeded kidnappings: a camera maps a stretch of its path, then finds itself elsewhere on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.geometry import invert, make_pose, relative_angle, so3_exp, transform_points
from ms_slam_env.metrics import relocalisation_times
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import FRAME_RATE_HZ, RGBDSensor
from ms_slam_env.sequences import handheld_trajectory
from ms_slam_env.slam import SlamBackend

DEPTH_LIMIT_M = 3.0  # readings beyond count neither as mapped nor as not
FOUND_M, FOUND_DEG = 0.05, 5.0
WRONG_M, WRONG_DEG = 0.10, 10.0
_CLEARANCE_M = 0.1
_AWAY_M, _AWAY_DEG = 0.3, 30.0  # a kidnapping ends at least so far from where it began
_DRAWS = 300
_VIEW = xtion("80x60").scaled(0.5)  # of the images by which mapped space is known
_EVERY = 4  # mapped frames that are looked at
_SAME_M = 0.05  # a point this close to the surface that a mapped frame saw was seen


@dataclass(frozen=True)
class Setting:
    """A kind of interruption.

    Attributes:
        offset_m: the camera reappears up to so far from a random earlier pose
        offset_deg: and turned by up to so much.
        mapped: least share of the view's readings there that the map holds.
        black: fewest and most black frames in between; while they last the camera goes back along
            its path, else it jumps to anywhere on it.
    """

    offset_m: float
    offset_deg: float
    mapped: float
    black: tuple[int, int] | None = None


SETTINGS: dict[str, Setting] = {
    "near": Setting(0.20, 15.0, 0.6),
    "far": Setting(0.40, 30.0, 0.5),
    "black": Setting(0.05, 4.0, 0.6, (5, 20)),
}
FOREIGN = "foreign"
"""One more kind: the camera reappears in another scene, and nothing there may be recognised."""
ALL_SETTINGS = (*SETTINGS, FOREIGN)


@dataclass(frozen=True)
class Interruption:
    """One interruption.

    Attributes:
        black: number of black frames before the camera sees again.
        poses: (N, 4, 4) true poses from then on.
        source: index of the mapped pose that the first of them is near; -1 for none.
        mapped: share of the first view's readings that lie in mapped space.
    """

    black: int
    poses: Float64
    source: int
    mapped: float


def map_path(scene: Scene, frames: int, seed: int) -> Float64:
    """Poses (frames, 4, 4) of the stretch that is mapped."""
    return handheld_trajectory(scene, frames, seed)


class MappedSpace:
    """What a camera has seen from the poses of a path."""

    def __init__(self, scene: Scene, path: Float64, intrinsics: Intrinsics = _VIEW) -> None:
        """Look from every few poses of ``path`` (N, 4, 4)."""
        self._sensor = RGBDSensor(scene, intrinsics, noise="none")
        self._intrinsics = intrinsics
        some = path[::_EVERY]
        self._world_to_camera = [invert(pose) for pose in some]
        self._depths = [self._sensor.ground_truth(pose).depth for pose in some]

    def share(self, T_world_camera: Float64) -> float:
        """Share of the readings from a pose (4, 4) that the path has seen.

        0 where less than half of the pixels have a reading in the range of the map.
        """
        view = self._sensor.ground_truth(T_world_camera)
        reading = (view.depth > 0) & (view.depth <= DEPTH_LIMIT_M)
        if reading.mean() < 0.5:
            return 0.0
        points = view.points[reading].astype(np.float64)
        seen = np.zeros(len(points), dtype=bool)
        height, width = self._intrinsics.shape
        for T_camera_world, depth in zip(self._world_to_camera, self._depths, strict=True):
            local = transform_points(T_camera_world, points)
            z = np.maximum(local[:, 2], 1e-6)
            u, v = np.rint(self._intrinsics.project(np.c_[local[:, :2], z])).T
            inside = (local[:, 2] > 0.05) & (local[:, 2] <= DEPTH_LIMIT_M)
            inside &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
            at = depth[v[inside].astype(int), u[inside].astype(int)]
            # One pixel is centimetres of a slanted surface.
            near = np.abs(at - z[inside]) < _SAME_M * np.maximum(1.0, z[inside])
            seen[np.flatnonzero(inside)[near]] = True
        return float(seen.mean())


def draw_interruption(
    scene: Scene,
    path: Float64,
    space: MappedSpace,
    setting: Setting,
    after: int,
    rng: np.random.Generator,
) -> Interruption | None:
    """Draw one interruption at the end of ``path`` (M, 4, 4) with ``after`` frames behind it.

    None if no pose was found that satisfies the setting.
    """
    for _ in range(_DRAWS):
        offset = _random_motion(setting, rng)
        if setting.black is None:
            black, forwards = 0, rng.random() < 0.5
            source = int(rng.integers(0, len(path)))
        else:
            black, forwards = int(rng.integers(setting.black[0], setting.black[1] + 1)), False
            source = len(path) - 1 - black
        steps = source + np.arange(after) * (1 if forwards else -1)
        if steps.min() < 0 or steps.max() >= len(path):
            continue
        poses = path[steps] @ offset
        if scene.clearance(poses[:, :3, 3]).min() < _CLEARANCE_M:
            continue
        if setting.black is None and not _is_away(path[-1], poses[0]):
            continue
        share = space.share(poses[0])
        if share >= setting.mapped:
            return Interruption(black, poses, source, share)
    return None


def foreign_interruption(other: Scene, after: int, seed: int) -> Interruption:
    """The camera reappears on a path of its own in scene ``other``."""
    return Interruption(0, handheld_trajectory(other, after, seed), -1, 0.0)


def _random_motion(setting: Setting, rng: np.random.Generator) -> Float64:
    """A motion (4, 4) of uniform size up to the setting's in a uniform direction."""
    turn, step = rng.normal(size=3), rng.normal(size=3)
    turn *= np.radians(setting.offset_deg) * rng.random() / np.linalg.norm(turn)
    step *= setting.offset_m * rng.random() / np.linalg.norm(step)
    return make_pose(so3_exp(turn), step)


def _is_away(a: Float64, b: Float64) -> bool:
    moved = np.linalg.norm(a[:3, 3] - b[:3, 3]) >= _AWAY_M
    return bool(moved or relative_angle(a[:3, :3], b[:3, :3]) >= np.radians(_AWAY_DEG))


def interrupt(
    backend: SlamBackend, one: Interruption, frames: list[RGBDFrame], expected: Float64 | None
) -> dict[str, Any]:
    """Put a SLAM that has mapped a path through an interruption.

    Args:
        backend: the SLAM.
        one: the interruption.
        frames: N, taken after it.
        expected: (N, 4, 4) their poses in the map; None if they show nothing that it holds.

    Returns:
        ``found``: a pose within 5 cm and 5 degrees of the expected one was given; ``wrong``: one
        farther than 10 cm or 10 degrees off was, or any where none is expected; the others as the
        registry defines them.
    """
    height, width = frames[0].depth.shape
    nothing = RGBDFrame(
        np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    )
    dark = run_sequence(backend, [nothing] * one.black, reset=False)
    run = run_sequence(backend, frames, reset=False)
    tracked = run.anchored  # in a submap of its own the camera is not found yet
    errors = []
    if expected is not None:
        errors = [_error(run.estimates[i], expected[i]) for i in np.flatnonzero(tracked)]
    seconds = np.arange(len(frames) + 1) / FRAME_RATE_HZ
    interrupted = [True] + [False] * len(frames)
    first = int(tracked.argmax()) if tracked.any() else None
    far = [m > WRONG_M or deg > WRONG_DEG for m, deg in errors]
    return {
        "found": any(m < FOUND_M and deg < FOUND_DEG for m, deg in errors),
        "wrong": any(far) or (expected is None and bool(tracked.any())),
        "frames_to_pose": math.inf if first is None else first,
        "relocalisation_s": float(
            relocalisation_times(seconds, interrupted, [False, *tracked.tolist()])[0]
        ),
        "first_error_m": errors[0][0] if errors else None,
        "first_error_deg": errors[0][1] if errors else None,
        "lost_frame_cpu_ms": float(np.mean(run.cpu_ms[: None if first is None else first + 1])),
        "black_frames": one.black,
        "black_tracked": len(dark) - dark.lost_frames,
        "mapped_share": one.mapped,
    }


def _error(estimate: Float64, truth: Float64) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return distance, float(np.degrees(relative_angle(estimate[:3, :3], truth[:3, :3])))
