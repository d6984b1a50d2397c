"""When frames are taken: a camera in haste, frames left out and lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import Float64
from ms_slam_env.sequences.perturbations.base import (
    FrameSelection,
    Int64,
    MotionPerturbation,
    random_numbers,
)
from ms_slam_env.sequences.trajectory import PoseInterpolation

_STEP_S = 1e-3
_RAMP = 0.25  # share of a stretch over which the speed rises, and falls again


@dataclass(frozen=True)
class FastMotion(Checked, MotionPerturbation):
    """The camera hurries: the same path, in stretches ``factor`` times as fast.

    The time between frames does not change, so a hurried path has fewer frames. Speed rises and
    falls smoothly. Frames have the poses of where the camera then is.

    Attributes:
        factor: of the speed in the middle of a stretch; 1 = off.
        share: of the time that is in stretches.
        length_s: of one stretch; shorter where the path is too short for it.
        seed: of when they begin, beside the sequence's.
    """

    factor: float = bounded(3.0, 1.0, 100.0)
    share: float = bounded(0.4, 0.0, 1.0)
    length_s: float = bounded(1.0, 0.01, 1e4)
    seed: int = bounded(0, 0, 2**32)

    def retime(self, path: PoseInterpolation, seed: int) -> PoseInterpolation:
        """See the base class."""
        if self.factor == 1 or self.share == 0 or len(path.times_s) < 2:
            return path
        progress = self.progress(path.times_s - path.times_s[0], seed)
        is_reached = progress <= path.times_s[-1] - path.times_s[0]
        count = max(2, int(is_reached.sum()))  # increasing: the first ones
        return PoseInterpolation(path.times_s[:count], path(path.times_s[0] + progress[:count]))

    def progress(self, since_s: Float64, seed: int) -> Float64:
        """How far along the path (N,), in seconds of the old pace, at times (N,) since 0 s."""
        dense = np.arange(0.0, since_s[-1] + 2 * _STEP_S, _STEP_S)
        pace = 1.0 + (self.factor - 1.0) * self._hurry(dense, seed)
        way = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) * _STEP_S)])
        return np.interp(since_s, dense, way)

    def _hurry(self, t: Float64, seed: int) -> Float64:
        """0 outside of the stretches, 1 in their middle: one stretch in every period."""
        length = min(self.length_s, self.share * t[-1])  # a short path has a stretch too
        period = length / self.share
        number = (t // period).astype(np.int64)
        rng = random_numbers(seed, self.seed, name="fast-motion")
        begins = rng.uniform(0.0, period - length, int(number[-1]) + 1)[number]
        along = (t - number * period - begins) / length  # 0 to 1 within the stretch
        ramp = np.clip(np.minimum(along, 1.0 - along) / _RAMP, 0.0, 1.0)
        return ramp * ramp * (3.0 - 2.0 * ramp)


@dataclass(frozen=True)
class FrameSkipping(Checked, FrameSelection):
    """Keeps every n-th frame, and loses some of those at random; the first is always kept.

    Attributes:
        keep_every: 1 = all.
        lost: probability that a frame is lost.
        seed: of the losses, beside the sequence's.
    """

    keep_every: int = bounded(2, 1, 1_000_000)
    lost: float = bounded(0.0, 0.0, 0.99)
    seed: int = bounded(0, 0, 2**32)

    def keep(self, count: int, seed: int) -> Int64:
        """See the base class."""
        kept = np.arange(0, count, self.keep_every)
        rng = random_numbers(seed, self.seed, name="frame-skipping")
        is_lost = rng.random(len(kept)) < self.lost
        is_lost[0] = False
        return kept[~is_lost]
