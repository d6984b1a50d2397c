"""Exposure that follows the brightness of what is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.affine import with_gain_and_bias
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment

_DARK = 1.0  # mean intensity below which brightness is not compensated further


@dataclass(frozen=True)
class AutoExposure(ImagePerturbation):
    """Gain that pulls the mean intensity back to the first frame's, with a lag.

    log g(k) = (1 - rate) log g(k - 1) + rate * strength * log(mean(0) / mean(k)), g(0) = 1.

    Attributes:
        strength: share of a change of brightness that is compensated; 0 = off, 1 = all of it.
        rate: share of the remaining error that is corrected at each frame.
        largest: gain stays within [1 / largest, largest].

    Raises:
        InputError: a value out of range.
    """

    strength: float = 1.0
    rate: float = 0.2
    largest: float = 4.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "strength", 0.0, 1.0)
        check_range(self, "rate", 0.001, 1.0)
        check_range(self, "largest", 1.0, 100.0)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """Of a frame."""
        mean = np.maximum(moment.brightness()[: moment.index + 1], _DARK)
        log_gain = 0.0
        for wanted in self.strength * np.log(mean[0] / mean[1:]):
            log_gain += self.rate * (wanted - log_gain)
        limit = np.log(self.largest)
        return float(np.exp(np.clip(log_gain, -limit, limit))), 0.0

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        return with_gain_and_bias(frame, *self.gain_and_bias(moment))
