"""Exposure that changes from one frame to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.affine import with_gain_and_bias
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment, random_numbers


@dataclass(frozen=True)
class ExposureJumps(ImagePerturbation):
    """Gain and bias of the colour values, drawn anew every few frames and held until the next draw.

    The first frames are unchanged.

    Attributes:
        gain: largest factor up or down; the logarithm is uniform; 1 = no change.
        bias: largest bias up or down, in steps of 255.
        every: frames between two draws.
        seed: of the draws, beside the sequence's.

    Raises:
        InputError: a value out of range.
    """

    gain: float = 1.5
    bias: float = 10.0
    every: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "gain", 1.0, 100.0)
        check_range(self, "bias", 0.0, 255.0)
        check_range(self, "every", 1, 1_000_000)
        check_range(self, "seed", 0, 2**32)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """Of a frame."""
        period = moment.index // self.every
        if period == 0:
            return 1.0, 0.0
        rng = random_numbers(moment.seed, self.seed, period, name="exposure-jumps")
        a, b = rng.uniform(-1.0, 1.0, 2)
        return float(np.exp(a * np.log(self.gain))), float(b * self.bias)

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        return with_gain_and_bias(frame, *self.gain_and_bias(moment))
