"""A hand-held camera at a stated pace: seeded, smooth, open or closed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sequences.camera_path import CameraPath
from ms_slam_env.sequences.loops import closed_paths
from ms_slam_env.sequences.path_shape import frame_times, hand_tremor, resample
from ms_slam_env.sequences.trajectories import RADIUS_M, free_path

Float64 = NDArray[np.float64]

_STARTS = 5
_CLOSED_PATHS = 4  # to choose among, per start
_PACE_PERIODS_S = (2.3, 5.1, 11.7)


@dataclass(frozen=True)
class HandheldPath(Checked, CameraPath):
    """How a camera is carried through a scene.

    At every instant it moves at the pace that whichever of the two speeds permits that is reached
    first: along straights the first, in turns the second. The pace varies slowly about its mean.

    Attributes:
        frames: number of poses.
        rate_hz: of the frames.
        speed_m_s: mean speed of the camera where it does not turn.
        turn_deg_s: mean speed of rotation where it turns.
        variation: the pace varies by this share, up and down.
        max_step_m: largest translation from frame to frame, without the tremor.
        max_turn_deg: largest rotation from frame to frame, without the tremor.
        loop: whether it returns to the start, turning once around on the way and going back by
            another way if the scene has one; the path is then shared out evenly over the frames,
            in several rounds if there are many, and slower than the pace where it must be.

    Raises:
        InputError: a value out of range.
    """

    frames: int = bounded(300, 2, 1_000_000)
    rate_hz: float = bounded(30.0, 0.1, 10_000.0)
    speed_m_s: float = bounded(0.5, 1e-3, 100.0)
    turn_deg_s: float = bounded(30.0, 1e-2, 1e4)
    variation: float = bounded(0.3, 0.0, 0.9)
    max_step_m: float = bounded(0.04, 1e-4, 10.0)
    max_turn_deg: float = bounded(2.0, 1e-3, 180.0)
    loop: bool = False

    @property
    def timestamps(self) -> Float64:
        """(frames,) seconds."""
        return np.arange(self.frames) / self.rate_hz

    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4)."""
        return self.timestamps, self.poses(scene, seed)

    def poses(self, scene: Scene, seed: int) -> Float64:
        """T_world_camera (frames, 4, 4); the same scene and seed give the same path.

        Raises:
            InputError: no free path, or no loop as short as that; the message says how many frames
                the shortest one needs.
        """
        rng = np.random.default_rng([seed, 78])
        pace = self._pace(rng)
        tremor = hand_tremor(self.frames, rng)
        step_m = self.speed_m_s / self.rate_hz
        rot_rad = np.radians(self.turn_deg_s) / self.rate_hz
        if not self.loop:
            path, times = free_path(scene, float(pace[-1]), rng, step_m, rot_rad)
            return resample(path, times, pace, tremor)
        path, times = self._closed(scene, float(pace[-1]), rng, step_m, rot_rad)
        rounds = max(1, int(pace[-1] / times[-1]))
        return resample(path, times, _around(pace * rounds / pace[-1], times[-1]), tremor)

    def _pace(self, rng: np.random.Generator) -> Float64:
        """Progress (frames,) in frames at the mean pace; no step exceeds the limits."""
        t = self.timestamps[:, None]
        phase = rng.uniform(0, 2 * np.pi, len(_PACE_PERIODS_S))
        waves = np.sin(2 * np.pi * t / np.array(_PACE_PERIODS_S) + phase).mean(axis=1)
        limit = min(
            self.max_step_m * self.rate_hz / self.speed_m_s,
            self.max_turn_deg * self.rate_hz / self.turn_deg_s,
        )
        steps = np.minimum(1.0 + self.variation * waves, limit)
        return np.concatenate([[0.0], np.cumsum(steps[1:])])

    def _closed(
        self, scene: Scene, length: float, rng: np.random.Generator, step_m: float, rot_rad: float
    ) -> tuple[Float64, Float64]:
        """The longest closed path that takes at most ``length`` frames at the mean pace."""
        where = f"scene {scene.name!r}, seed {scene.seed}"
        shortest = 2 * np.pi / rot_rad  # the turn alone
        lengths: list[float] = []
        for _ in range(_STARTS if shortest <= length else 0):
            fitting: list[tuple[Float64, Float64]] = []
            for path in itertools.islice(closed_paths(scene, rng, RADIUS_M), _CLOSED_PATHS):
                times = frame_times(path, step_m, rot_rad)
                lengths.append(times[-1])
                if times[-1] <= length:
                    fitting.append((path, times))
            if fitting:
                return max(fitting, key=lambda found: found[1][-1])
        if shortest <= length and not lengths:
            raise InputError(f"found no closed path of a camera in {where}")
        raise InputError(
            f"a loop in {where} takes at least {min(lengths, default=shortest) + 1:.0f} frames at "
            f"this pace, not {self.frames}"
        )


def _around(rounds: Float64, length: float) -> Float64:
    """Instants on a closed path after so many rounds, the end of the last round included."""
    instants = (rounds % 1.0) * length
    instants[-1] = length
    return instants
