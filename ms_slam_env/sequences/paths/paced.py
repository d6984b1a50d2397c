"""Hand-held camera paths with changing pace: slow and fast sections."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences.paths.camera_path import CameraPath, hand_tremor, resample
from ms_slam_env.sequences.paths.handheld import HandheldPath
from ms_slam_env.sequences.paths.wandering import free_path
from ms_slam_env.sequences.trajectory import PoseInterpolation

PACES = (0.1, 1.0, 4.0)
"""Paces of an `UnevenPath`: nearly still, walking, hurrying; multiples of its middle pace."""

_RATE_HZ = 30.0
_SEGMENT_S = (0.8, 2.0)  # shortest and longest time at one pace
_EASING_S = 0.25  # duration of the transition between paces
_RAMP = 6  # frames over which the pace of motion segments changes


@dataclass(frozen=True)
class UnevenPath(Checked, CameraPath):
    """A hand-held path at 0.5 m/s or 30 deg/s, at times ten times slower or four times faster.

    Attributes:
        frames: number of poses, 30 per second.
        speed_m_s: speed at the middle pace where it does not turn.
        turn_deg_s: angular speed at the middle pace where it turns.
    """

    frames: int = bounded(300, 30, 100_000)
    speed_m_s: float = bounded(0.5, 1e-3, 100.0)
    turn_deg_s: float = bounded(30.0, 1e-2, 1e4)

    def paces(self, seed: int) -> Float64:
        """Pace (frames,) at each frame: segments of 0.8 to 2 s, each pace once per round."""
        rng = np.random.default_rng([seed, 79])
        rates: list[float] = []
        while len(rates) < self.frames:
            for pace in rng.permutation(PACES):
                rates += [pace] * int(_RATE_HZ * rng.uniform(*_SEGMENT_S))
        width = int(_EASING_S * _RATE_HZ)
        padded = np.concatenate([[rates[0]] * width, rates])
        return np.convolve(padded, np.ones(width) / width, "valid")[: self.frames]

    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """See the base class."""
        progress = np.concatenate([[0.0], np.cumsum(self.paces(seed)[1:])])
        rng = np.random.default_rng([seed, 80])
        tremor = hand_tremor(self.frames, rng)
        step_m, rot_rad = self.speed_m_s / _RATE_HZ, np.radians(self.turn_deg_s) / _RATE_HZ
        path, times = free_path(scene, float(progress[-1]), rng, step_m, rot_rad)
        return np.arange(self.frames) / _RATE_HZ, resample(path, times, progress, tremor)


@dataclass(frozen=True)
class MotionSegments(Checked, CameraPath):
    """A hand-held path with alternating calm and violent segments.

    Attributes:
        frames: length of the sequence.
        rate_hz: frame rate.
        speed_m_s: mean speed in calm segments where the camera does not turn.
        turn_deg_s: mean angular speed in calm segments where it turns.
        quiet: frames of a calm segment; the sequence starts with one.
        violent: frames of the violent segment that follows.
        factor: speed factor in violent segments, on the same path.
    """

    frames: int = bounded(240, 4, 100_000)
    rate_hz: float = bounded(15.0, 0.1, 1000)
    speed_m_s: float = bounded(0.1, 1e-3, 100)
    turn_deg_s: float = bounded(7.5, 1e-2, 1e4)
    quiet: int = bounded(75, 1, 100_000)
    violent: int = bounded(30, 0, 100_000)
    factor: float = bounded(20.0, 1, 1000)

    def pace(self) -> Float64:
        """Speed factor (frames,) relative to calm, with smooth changes."""
        place = np.arange(self.frames) % (self.quiet + self.violent)
        into = np.minimum(place - self.quiet + 1, self.quiet + self.violent - place) / _RAMP
        share = 0.5 * (1.0 - np.cos(np.pi * np.clip(into, 0.0, 1.0)))
        return 1.0 + (self.factor - 1.0) * share

    def is_violent(self) -> NDArray[np.bool_]:
        """Whether (frames,) the pace is closer to violent than to calm."""
        return self.pace() > 0.5 * (1.0 + self.factor)

    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4)."""
        progress = np.concatenate([[0.0], np.cumsum(self.pace()[1:])])  # in calm frames
        calm = HandheldPath(
            frames=math.ceil(progress[-1]) + 2,
            rate_hz=self.rate_hz,
            speed_m_s=self.speed_m_s,
            turn_deg_s=self.turn_deg_s,
        )
        path = PoseInterpolation(*calm.motion(scene, seed))
        return np.arange(self.frames) / self.rate_hz, path(progress / self.rate_hz)
