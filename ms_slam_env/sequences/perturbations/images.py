"""Image perturbations: holes and steps in depth, changing exposure, black frames."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.sequences.perturbations.perturbation import (
    ImagePerturbation,
    Moment,
    random_numbers,
)

_ATTEMPTS = 10_000
_EDGE_JUMP = 0.05  # depth edge: neighbours differ by more than this share of the nearer one


_NATIVE_WIDTH = 640


@dataclass(frozen=True)
class DepthDropout(Checked, ImagePerturbation):
    """Holes in depth: patches, along edges, and single pixels, drawn for every frame.

    Attributes:
        patches: least share of the image covered by elliptic patches; 0 = none.
        patch_size: mean diameter of a patch as a share of the image's width.
        edge_px: pixels on either side of a depth edge that have no reading; 0 = none.
        pixels: probability that a single pixel has no reading.
        seed: seed of the holes, in addition to the sequence's.
    """

    patches: float = bounded(0.1, 0.0, 0.95)
    patch_size: float = bounded(0.1, 0.005, 1.0)
    edge_px: int = bounded(1, 0, 1000)
    pixels: float = bounded(0.01, 0.0, 1.0)
    seed: int = bounded(0, 0, 2**32)

    def holes(self, depth: NDArray[np.float32], moment: Moment) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels that lose their reading."""
        rng = random_numbers(moment.seed, self.seed, moment.index, name="depth-dropout")
        mask = self._patches(depth.shape, rng)
        if self.edge_px:
            distance = ndimage.distance_transform_cdt(~self._edges(depth), "taxicab")
            mask |= (distance >= 0) & (distance < self.edge_px)  # -1 if there is no edge
        return mask | (rng.random(depth.shape) < self.pixels)

    def _patches(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
        height, width = shape
        mask = np.zeros((height, width), dtype=bool)
        v, u = np.mgrid[:height, :width]
        for _ in range(_ATTEMPTS):
            if mask.mean() >= self.patches:
                break
            centre = rng.uniform((0, 0), (height, width))
            radii = 0.5 * self.patch_size * width * rng.uniform(0.5, 1.5, 2)
            mask |= ((v - centre[0]) / radii[0]) ** 2 + ((u - centre[1]) / radii[1]) ** 2 < 1.0
        return mask

    def _edges(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Pixels on both sides of a jump between two readings."""
        edges = np.zeros(depth.shape, dtype=bool)
        for axis in (0, 1):
            for turn in (1, -1):
                other = np.roll(depth, turn, axis)
                nearer = np.minimum(depth, other)
                jumps = (nearer > 0) & (np.abs(depth - other) > nearer * _EDGE_JUMP)
                jumps[(slice(None),) * axis + (0 if turn == 1 else -1,)] = False  # wrapped around
                edges |= jumps
        return edges

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        depth = np.where(self.holes(frame.depth, moment), np.float32(0), frame.depth)
        return dataclasses.replace(frame, depth=depth)


@dataclass(frozen=True)
class DepthQuantisation(Checked, ImagePerturbation):
    """Rounds the disparity d = f b / z of the 640 pixels wide sensor to whole steps.

    Source: Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 2012: baseline 7.5 cm, steps of an eighth of a pixel; the
    depth resolution step / (f b) * z^2 is their section 3.3. The sensor's noise model "kinect" has
    these steps already; this adds coarser ones, or steps to a sensor without noise.

    Attributes:
        step_px: step of the disparity in pixels; 0 = off.
        baseline_m: distance between projector and camera.
    """

    step_px: float = bounded(0.25, 0.0, 8.0)
    baseline_m: float = bounded(0.075, 1e-3, 1.0)

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        if self.step_px == 0:
            return frame
        native_fx = moment.intrinsics.fx * _NATIVE_WIDTH / moment.intrinsics.width
        unit = native_fx * self.baseline_m / self.step_px  # product of depth and disparity in steps
        is_read = frame.depth > 0
        steps = np.rint(unit / np.where(is_read, frame.depth, 1.0).astype(np.float64))
        depth = np.where(is_read & (steps >= 1), unit / np.maximum(steps, 1), 0.0)
        return dataclasses.replace(frame, depth=depth.astype(np.float32))


_DARK = 1.0  # least mean intensity that compensation assumes


class GainAndBias(ImagePerturbation):
    """Changes colour values c to round(gain * c + bias), clipped to [0, 255].

    The values are as stored (sRGB), so a gain g changes the light by about g^2.2.
    """

    @abstractmethod
    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """Gain and bias of a frame; the bias is in steps of 255."""

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
        strength: share of a brightness change that is compensated; 0 = off, 1 = all.
        rate: share of the remaining error corrected at each frame.
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
    """Changes gain and bias of the colours linearly, from none to these at the last frame.

    Attributes:
        gain: gain at the last frame; 1 = no change.
        bias: bias at the last frame, in steps of 255; 0 = no change.
    """

    gain: float = bounded(0.6, 0.01, 100.0)
    bias: float = bounded(0.0, -255.0, 255.0)

    def gain_and_bias(self, moment: Moment) -> tuple[float, float]:
        """See the base class."""
        s = moment.index / max(moment.count - 1, 1)
        return 1.0 + s * (self.gain - 1.0), s * self.bias


@dataclass(frozen=True)
class ExposureJumps(Checked, GainAndBias):
    """Draws a new gain and bias of the colours every few frames.

    The first frames are unchanged.

    Attributes:
        gain: largest factor up or down, with uniform logarithm; 1 = no change.
        bias: largest bias up or down, in steps of 255.
        every: number of frames between two draws.
        seed: seed of the draws, in addition to the sequence's.
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
    """Runs of consecutive frames without colour and depth.

    Attributes:
        start: first black frame (index on the trajectory).
        length: number of frames in a run; 0 = off.
        every: frames from the start of one run to the start of the next; 0 = one run only.
    """

    start: int = bounded(60, 0, 10_000_000)
    length: int = bounded(10, 0, 10_000_000)
    every: int = bounded(0, 0, 10_000_000)

    def is_black(self, index: int) -> bool:
        """Whether the frame with this index is black."""
        since = index - self.start
        if since < 0:
            return False
        return (since % self.every if self.every else since) < self.length

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        if not self.is_black(moment.index):
            return frame
        return dataclasses.replace(
            frame, color=np.zeros_like(frame.color), depth=np.zeros_like(frame.depth)
        )
