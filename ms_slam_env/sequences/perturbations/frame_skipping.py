"""Frames that are missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.base import FrameSelection, Int64, random_numbers


@dataclass(frozen=True)
class FrameSkipping(FrameSelection):
    """Keeps every n-th frame, and loses some of those at random; the first is always kept.

    Attributes:
        keep_every: 1 = all.
        lost: probability that a frame is lost.
        seed: of the losses, beside the sequence's.

    Raises:
        InputError: a value out of range.
    """

    keep_every: int = 2
    lost: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "keep_every", 1, 1_000_000)
        check_range(self, "lost", 0.0, 0.99)
        check_range(self, "seed", 0, 2**32)

    def keep(self, count: int, seed: int) -> Int64:
        """See the base class."""
        kept = np.arange(0, count, self.keep_every)
        rng = random_numbers(seed, self.seed, name="frame-skipping")
        is_lost = rng.random(len(kept)) < self.lost
        is_lost[0] = False
        return kept[~is_lost]
