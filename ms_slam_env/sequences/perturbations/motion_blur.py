"""Colour integrated while the camera moves."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.base import OpticalPerturbation, Optics


@dataclass(frozen=True)
class MotionBlur(OpticalPerturbation):
    """Colour is the mean of the linear light at instants spread over the exposure time.

    The exposure is centred on the time of the frame (of the row, if the shutter rolls). Depth,
    which is read from a projected pattern, is taken at the centre.

    Attributes:
        exposure_s: time over which light is gathered; 0 = off.
        samples: instants, evenly spaced.

    Raises:
        InputError: a value out of range.
    """

    exposure_s: float = 0.02
    samples: int = 8

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "exposure_s", 0.0, 10.0)
        check_range(self, "samples", 2, 256)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        if self.exposure_s == 0:
            return optics
        return dataclasses.replace(
            optics, exposure_s=self.exposure_s, exposure_samples=self.samples
        )
