"""Smooth, seeded, hand-held camera trajectories through a scene's free space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, relative_angle
from ms_slam_env.scenes.base import Scene

Float64 = NDArray[np.float64]

RADIUS_M = 0.25
"""Free space kept around the camera."""

_HOP_M = (0.35, 0.7)  # distance between waypoints
_GAZE_M = (0.6, 2.4)  # distance of what the camera looks at
_MAX_TURN_RAD = np.radians(50.0)  # between the viewing directions of two waypoints
_SAMPLES_PER_HOP = 40
_SHAKE_M = 0.002
_SHAKE_RATES = (0.05, 0.09, 0.13)  # cycles per frame
_ATTEMPTS = 200


def _unit(v: Float64) -> Float64:
    return v / np.linalg.norm(v)


class _Wanderer:
    """Draws waypoints and what to look at from each."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.rng = rng
        self.surface, self.labels = scene.surface_points(0.1)
        start = scene.sample_start(rng)
        self.height = start[2, 3]
        self.eyes = [start[:3, 3]]
        self.targets = [start[:3, 3] + 1.2 * start[:3, 2]]

    def hop(self) -> None:
        """Append one waypoint that the last one sees, and a visible surface point ahead."""
        for _ in range(_ATTEMPTS):
            step = self.rng.normal(size=3) * (1.0, 1.0, 0.35)
            eye = self.eyes[-1] + _unit(step) * self.rng.uniform(*_HOP_M)
            if abs(eye[2] - self.height) > 0.35:
                continue
            if not self.scene.segment_is_free(self.eyes[-1], eye, RADIUS_M):
                continue
            target = self._gaze(eye)
            if target is not None:
                self.eyes.append(eye)
                self.targets.append(target)
                return
        raise InputError(
            f"found no free path of a camera in scene {self.scene.name!r}, seed {self.scene.seed}"
        )

    def _gaze(self, eye: Float64) -> Float64 | None:
        offsets = self.surface - eye
        distance = np.linalg.norm(offsets, axis=1)
        before = _unit(self.targets[-1] - self.eyes[-1])
        turn = offsets @ before / np.maximum(distance, 1e-9)
        slope = np.abs(offsets[:, 2]) / np.maximum(distance, 1e-9)
        suitable = np.flatnonzero(
            (distance > _GAZE_M[0])
            & (distance < _GAZE_M[1])
            & (turn > np.cos(_MAX_TURN_RAD))
            & (slope < 0.8)
        )
        if not len(suitable):
            return None
        # Every object is as likely as a whole wall: people look at things.
        weights = 1.0 / np.bincount(self.labels[suitable])[self.labels[suitable]]
        count = min(10, len(suitable))
        drawn = self.rng.choice(suitable, count, replace=False, p=weights / weights.sum())
        for target in self.surface[drawn]:
            short = target - 0.05 * _unit(target - eye)
            if self.scene.segment_is_free(eye, short, 0.01):
                return target
        return None


def _dense_path(wanderer: _Wanderer) -> Float64:
    """Poses (M, 4, 4), finely spaced, on splines through the waypoints and the gaze targets."""
    knots = np.arange(len(wanderer.eyes), dtype=np.float64)
    s = np.linspace(0.0, knots[-1], _SAMPLES_PER_HOP * (len(knots) - 1) + 1)
    eyes = CubicSpline(knots, np.stack(wanderer.eyes))(s)
    # The viewing direction, not the target, is interpolated: two targets may lie on both sides.
    directions = np.stack(
        [_unit(t - e) for e, t in zip(wanderer.eyes, wanderer.targets, strict=True)]
    )
    aims = CubicSpline(knots, directions)(s)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, aims, strict=True)])


def _frame_times(path: Float64, speed_m: float, rot_rad: float) -> Float64:
    """Frame number (M,) at which each sample is reached if neither speed limit is exceeded."""
    travel = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1) / speed_m
    turn = [
        relative_angle(a, b) / rot_rad
        for a, b in zip(path[:-1, :3, :3], path[1:, :3, :3], strict=True)
    ]
    return np.concatenate([[0.0], np.cumsum(np.maximum(travel, turn))])


def _resample(path: Float64, times: Float64, frames: int, shake: Float64) -> Float64:
    """Poses at frames 0, 1, ...; positions are moved by ``shake`` (frames, 3) in metres."""
    instants = np.arange(frames, dtype=np.float64)
    eyes = np.stack([np.interp(instants, times, path[:, k, 3]) for k in range(3)], axis=1)
    aims = np.stack([np.interp(instants, times, path[:, k, 2]) for k in range(3)], axis=1)
    # Moving the eye twice as far as the point one metre ahead shakes the direction as well.
    return np.stack(
        [look_at(eye + d, eye + aim - d) for eye, aim, d in zip(eyes, aims, shake, strict=True)]
    )


def _shake(frames: int, rng: np.random.Generator) -> Float64:
    """Tremor of the hand (frames, 3) in metres: three sines an axis."""
    t = np.arange(frames)[:, None]
    total = np.zeros((frames, 3))
    for rate in _SHAKE_RATES:
        phase = rng.uniform(0, 2 * np.pi, 3)
        amplitude = rng.uniform(0.2, 1.0, 3) * _SHAKE_M / len(_SHAKE_RATES)
        total += amplitude * np.sin(2 * np.pi * rate * t + phase)
    return total


def handheld_trajectory(
    scene: Scene, frames: int, seed: int, speed_m: float = 0.015, rot_deg: float = 1.0
) -> Float64:
    """Poses T_world_camera (frames, 4, 4) of a camera carried through free space.

    Splines through random free waypoints; at each the camera looks at a visible surface. It moves
    as fast as the two limits permit, with a tremor of about 2 mm on top.

    Args:
        scene: where to move.
        frames: number of poses.
        seed: of the waypoints.
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
        wanderer = _Wanderer(scene, rng)
        wanderer.hop()
        path = _dense_path(wanderer)
        times = _frame_times(path, speed_m, np.radians(rot_deg))
        while times[-1] < frames - 1:
            wanderer.hop()
            path = _dense_path(wanderer)
            times = _frame_times(path, speed_m, np.radians(rot_deg))
        poses = _resample(path, times, frames, _shake(frames, rng))
        # The spline swings out between waypoints, so the segments' clearance is not enough.
        if scene.clearance(poses[:, :3, 3]).min() > 0.5 * RADIUS_M:
            return poses
    raise InputError(f"found no free trajectory in scene {scene.name!r}, seed {scene.seed}")


def repeated_trajectory(
    scene: Scene,
    frames: int,
    seed: int,
    passes: int = 2,
    speed_m: float = 0.015,
    rot_deg: float = 1.0,
) -> Float64:
    """Poses (passes * frames, 4, 4): the same way there and back, ``passes`` times.

    Every pass has the same ``frames`` poses and ends where it began, so nothing that a later pass
    sees is new.

    Raises:
        InputError: fewer than 4 frames, fewer than 1 pass, or as handheld_trajectory.
    """
    if frames < 4 or passes < 1:
        raise InputError(f"need at least 4 frames and 1 pass, got {frames} and {passes}")
    there = handheld_trajectory(scene, (frames + 1) // 2, seed, speed_m, rot_deg)
    back = there[::-1][: frames // 2]
    return np.tile(np.concatenate([there, back]), (passes, 1, 1))
