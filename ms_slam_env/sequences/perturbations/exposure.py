"""How bright the colour images are: automatic, drifting and jumping exposure, and darkness."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment, random_numbers

_DARK = 1.0  # mean intensity below which brightness is not compensated further


class GainAndBias(ImagePerturbation):
    """Colour values c become round(gain * c + bias), held within [0, 255].

    The values are as stored (sRGB), so a gain g is a change of the light by about g^2.2.
    """

    @abstractmethod
    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """Of a frame; the bias in steps of 255."""

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        gain, bias = self.gain_and_bias(moment)
        changed = np.rint(gain * frame.color.astype(np.float32) + bias)
        return dataclasses.replace(frame, color=np.clip(changed, 0, 255).astype(np.uint8))


@dataclass(frozen=True)
class AutoExposure(Checked, GainAndBias):
    """Gain that pulls the mean intensity back to the first frame's, with a lag.

    log g(k) = (1 - rate) log g(k - 1) + rate * strength * log(mean(0) / mean(k)), g(0) = 1.

    Attributes:
        strength: share of a change of brightness that is compensated; 0 = off, 1 = all of it.
        rate: share of the remaining error that is corrected at each frame.
        largest: gain stays within [1 / largest, largest].
    """

    strength: float = bounded(1.0, 0.0, 1.0)
    rate: float = bounded(0.2, 0.001, 1.0)
    largest: float = bounded(4.0, 1.0, 100.0)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """See the base class."""
        mean = np.maximum(moment.brightness()[: moment.index + 1], _DARK)
        log_gain = 0.0
        for wanted in self.strength * np.log(mean[0] / mean[1:]):
            log_gain += self.rate * (wanted - log_gain)
        limit = np.log(self.largest)
        return float(np.exp(np.clip(log_gain, -limit, limit))), 0.0


@dataclass(frozen=True)
class ExposureRamp(Checked, GainAndBias):
    """Gain and bias of the colour values, linear from none at the first frame to these at the last.

    Attributes:
        gain: at the last frame; 1 = no change.
        bias: at the last frame, in steps of 255; 0 = no change.
    """

    gain: float = bounded(0.6, 0.01, 100.0)
    bias: float = bounded(0.0, -255.0, 255.0)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """See the base class."""
        s = moment.index / max(moment.count - 1, 1)
        return 1.0 + s * (self.gain - 1.0), s * self.bias


@dataclass(frozen=True)
class ExposureJumps(Checked, GainAndBias):
    """Gain and bias of the colour values, drawn anew every few frames and held until the next draw.

    The first frames are unchanged.

    Attributes:
        gain: largest factor up or down; the logarithm is uniform; 1 = no change.
        bias: largest bias up or down, in steps of 255.
        every: frames between two draws.
        seed: of the draws, beside the sequence's.
    """

    gain: float = bounded(1.5, 1.0, 100.0)
    bias: float = bounded(10.0, 0.0, 255.0)
    every: int = bounded(20, 1, 1_000_000)
    seed: int = bounded(0, 0, 2**32)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """See the base class."""
        period = moment.index // self.every
        if period == 0:
            return 1.0, 0.0
        rng = random_numbers(moment.seed, self.seed, period, name="exposure-jumps")
        a, b = rng.uniform(-1.0, 1.0, 2)
        return float(np.exp(a * np.log(self.gain))), float(b * self.bias)


@dataclass(frozen=True)
class BlackFrames(Checked, ImagePerturbation):
    """Runs of frames without colour, and without depth unless told otherwise.

    Attributes:
        start: first black frame (index on the trajectory).
        length: frames in a row; 0 = off.
        every: frames from the start of one run to the start of the next; 0 = one run only.
        keep_depth: whether depth is still read, as when the light goes out.
    """

    start: int = bounded(60, 0, 10_000_000)
    length: int = bounded(10, 0, 10_000_000)
    every: int = bounded(0, 0, 10_000_000)
    keep_depth: bool = False

    def is_black(self, index: int) -> bool:
        """Whether the frame of this index is black."""
        since = index - self.start
        if since < 0:
            return False
        return (since % self.every if self.every else since) < self.length

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        if not self.is_black(moment.index):
            return frame
        depth = frame.depth if self.keep_depth else np.zeros_like(frame.depth)
        return dataclasses.replace(frame, color=np.zeros_like(frame.color), depth=depth)
