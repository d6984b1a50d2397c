"""Hand-held camera paths that wander through free space, looking at visible surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences.paths.camera_path import (
    CameraPath,
    dense_path,
    frame_times,
    hand_tremor,
    resample,
    unit,
)

_NEAREST_M = 0.6
_MAX_SLOPE = 0.8  # sine of the angle above or below the horizon
_LOOKS = 10
RADIUS_M = 0.25
"""Least clearance of the camera."""
_HOP_M = (0.35, 0.7)  # distance between waypoints
_MAX_TURN_RAD = np.radians(50.0)  # largest angle between the viewing directions of two waypoints
_ATTEMPTS = 200
_LEAP = 0.8


class Gaze:
    """Chooses visible surface points of a scene at a distance suitable for a depth camera."""

    def __init__(self, scene: Scene) -> None:
        """Sample the scene's surface."""
        self.scene = scene
        self.surface, self.labels = scene.surface_points(0.1)

    def choose(
        self,
        eye: Float64,
        cones: Sequence[tuple[Float64, float]],
        rng: np.random.Generator,
        farthest_m: float | None = None,
    ) -> Float64 | None:
        """Choose a surface point (3,) visible from ``eye`` (3,); None if there is none.

        Args:
            eye: position of the camera.
            cones: unit vectors (3,), and the angle in radians within which the point must be of
                each.
            rng: draws among the suitable points.
            farthest_m: largest distance from the camera; the scene's by default.
        """
        farthest_m = self.scene.gaze_m if farthest_m is None else farthest_m
        offsets = self.surface - eye
        distance = np.linalg.norm(offsets, axis=1)
        slope = np.abs(offsets[:, 2]) / np.maximum(distance, 1e-9)
        is_suitable = (distance > _NEAREST_M) & (distance < farthest_m) & (slope < _MAX_SLOPE)
        for axis, angle_rad in cones:
            is_suitable &= offsets @ axis / np.maximum(distance, 1e-9) > np.cos(angle_rad)
        suitable = np.flatnonzero(is_suitable)
        if not len(suitable):
            return None
        # An object is as likely as a whole wall, because people look at things.
        weights = 1.0 / np.bincount(self.labels[suitable])[self.labels[suitable]]
        count = min(_LOOKS, len(suitable))
        drawn = rng.choice(suitable, count, replace=False, p=weights / weights.sum())
        for target in self.surface[drawn]:
            short = target - self.scene.gaze_gap_m * unit(target - eye)
            if self.scene.segment_is_free(eye, short, 0.01):
                return target
        return None


class Wanderer:
    """Draws waypoints and a target to look at from each."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.rng = rng
        self.gaze = Gaze(scene)
        start = scene.sample_start(rng)
        self.height = start[2, 3]
        self.eyes = [start[:3, 3]]
        self.targets = [start[:3, 3] + 1.2 * start[:3, 2]]

    def hop(self) -> None:
        """Append a waypoint visible from the last one, and a visible surface point ahead."""
        for _ in range(_ATTEMPTS):
            step = self.rng.normal(size=3) * (1.0, 1.0, 0.35)
            eye = self.eyes[-1] + unit(step) * self.rng.uniform(*_HOP_M)
            if abs(eye[2] - self.height) > 0.35:
                continue
            if not self.scene.segment_is_free(self.eyes[-1], eye, RADIUS_M):
                continue
            before = unit(self.targets[-1] - self.eyes[-1])
            target = self.gaze.choose(eye, ((before, _MAX_TURN_RAD),), self.rng)
            if target is not None:
                self.eyes.append(eye)
                self.targets.append(target)
                return
        raise InputError(
            f"found no free path of a camera in scene {self.scene.name!r}, seed {self.scene.seed}"
        )


def handheld_trajectory(
    scene: Scene, frames: int, seed: int, speed_m: float = 0.015, rot_deg: float = 1.0
) -> Float64:
    """Poses T_world_camera (frames, 4, 4) of a hand-held camera in free space.

    Splines through random free waypoints; at each the camera looks at a visible surface. It moves
    as fast as the two limits permit, with a tremor of about 2 mm on top.

    Args:
        scene: the scene.
        frames: number of poses.
        seed: seed of the waypoints.
        speed_m: largest translation from frame to frame, without the tremor.
        rot_deg: largest rotation from frame to frame, without the tremor.

    Raises:
        InputError: fewer than 2 frames, limits that are not positive, or no free path.
    """
    if frames < 2:
        raise InputError(f"a trajectory needs at least 2 frames, got {frames}")
    if not (np.isfinite([speed_m, rot_deg]).all() and min(speed_m, rot_deg) > 0):
        raise InputError(f"speeds must be finite and > 0, got {speed_m} m and {rot_deg} degrees")
    rng = np.random.default_rng([seed, 77])
    for _ in range(_ATTEMPTS):
        path, times = _wander(scene, frames - 1, rng, speed_m, np.radians(rot_deg))
        poses = resample(path, times, np.arange(frames), hand_tremor(frames, rng))
        if _is_free(scene, poses):
            return poses
    raise InputError(f"found no free trajectory in scene {scene.name!r}, seed {scene.seed}")


def _wander(
    scene: Scene,
    length: float,
    rng: np.random.Generator,
    speed_m: float,
    rot_rad: float,
    leap: float = 0.0,
) -> tuple[Float64, Float64]:
    """A dense path and its frame times, of at least ``length`` frames.

    ``leap`` is the share of the estimated missing hops to add before recomputing the path; 0 = one
    hop, which takes time quadratic in the length.
    """
    wanderer = Wanderer(scene, rng)
    wanderer.hop()
    path = dense_path(wanderer.eyes, wanderer.targets)
    times = frame_times(path, speed_m, rot_rad)
    while times[-1] < length:
        missing = (length - times[-1]) / times[-1] * (len(wanderer.eyes) - 1)
        for _ in range(max(1, int(leap * missing))):
            wanderer.hop()
        path = dense_path(wanderer.eyes, wanderer.targets)
        times = frame_times(path, speed_m, rot_rad)
    return path, times


def _is_free(scene: Scene, poses: Float64) -> bool:
    """Whether the path is clear; splines swing out, so checking the segments is not enough."""
    return bool(scene.clearance(poses[:, :3, 3]).min() > 0.5 * RADIUS_M)


def free_path(
    scene: Scene, length: float, rng: np.random.Generator, speed_m: float, rot_rad: float
) -> tuple[Float64, Float64]:
    """Dense poses (M, 4, 4) of an open path and the frame numbers (M,) at which they are reached.

    Args:
        scene: the scene.
        length: number of the last frame that it must reach.
        rng: draws the waypoints.
        speed_m: largest translation from frame to frame.
        rot_rad: largest rotation from frame to frame.

    Raises:
        InputError: no free path.
    """
    for _ in range(_ATTEMPTS):
        path, times = _wander(scene, length, rng, speed_m, rot_rad, _LEAP)
        if _is_free(scene, path[: int(np.searchsorted(times, length)) + 1]):
            return path, times
    raise InputError(f"found no free trajectory in scene {scene.name!r}, seed {scene.seed}")


@dataclass(frozen=True)
class WanderingPath(Checked, CameraPath):
    """A hand-held path that is always as fast as two limits permit: ``handheld_trajectory``.

    Attributes:
        frames: number of poses, 30 per second.
        step_m: largest translation from frame to frame, without the tremor.
        step_deg: largest rotation from frame to frame, without the tremor.
    """

    frames: int = bounded(300, 2, 1_000_000)
    step_m: float = bounded(0.015, 1e-4, 10.0)
    step_deg: float = bounded(1.0, 1e-3, 180.0)

    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4)."""
        from ms_slam_env.sensor import FRAME_RATE_HZ

        poses = handheld_trajectory(scene, self.frames, seed, self.step_m, self.step_deg)
        return np.arange(self.frames) / FRAME_RATE_HZ, poses
