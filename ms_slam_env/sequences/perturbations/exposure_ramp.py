"""Exposure that changes steadily."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.affine import with_gain_and_bias
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment


@dataclass(frozen=True)
class ExposureRamp(ImagePerturbation):
    """Gain and bias of the colour values, linear from none at the first frame to these at the last.

    Attributes:
        gain: at the last frame; 1 = no change.
        bias: at the last frame, in steps of 255; 0 = no change.

    Raises:
        InputError: a value out of range.
    """

    gain: float = 0.6
    bias: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "gain", 0.01, 100.0)
        check_range(self, "bias", -255.0, 255.0)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """Of a frame."""
        s = moment.index / max(moment.count - 1, 1)
        return 1.0 + s * (self.gain - 1.0), s * self.bias

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        return with_gain_and_bias(frame, *self.gain_and_bias(moment))
