"""Perturbations of optics (shutter, blur, misregistration, lens) and timing."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.camera import Distortion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import make_pose
from ms_slam_env.sensor import NoiseConfig
from ms_slam_env.sequences.perturbations.perturbation import (
    FrameSelection,
    MotionPerturbation,
    OpticalPerturbation,
    Optics,
    random_numbers,
)
from ms_slam_env.sequences.trajectory import PoseInterpolation


@dataclass(frozen=True)
class RollingShutter(Checked, OpticalPerturbation):
    """Rolling shutter: colour and depth are read row by row, top to bottom, during motion.

    Every two rows are rendered from the camera's pose at their own time. A frame's time stamp, and
    so its true pose, is that of the middle row.

    Attributes:
        readout_s: time from the first row to the last; 0 = off. The default is most of the frame
            interval at 30 Hz.
    """

    readout_s: float = bounded(0.03, 0.0, 10.0)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        return dataclasses.replace(optics, readout_s=self.readout_s)


@dataclass(frozen=True)
class MotionBlur(Checked, OpticalPerturbation):
    """Motion blur: colour is the mean linear light over instants of the exposure time.

    The exposure is centred on the time of the frame, or of the row with a rolling shutter. Depth,
    which is read from a projected pattern, is taken at the centre.

    Attributes:
        exposure_s: exposure time; 0 = off.
        samples: number of evenly spaced instants.
    """

    exposure_s: float = bounded(0.02, 0.0, 10.0)
    samples: int = bounded(8, 2, 256)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        if self.exposure_s == 0:
            return optics
        return dataclasses.replace(
            optics, exposure_s=self.exposure_s, exposure_samples=self.samples
        )


@dataclass(frozen=True)
class Misregistration(Checked, OpticalPerturbation):
    """Misregistration: colour and depth come from two cameras but are treated as one.

    The frame's intrinsics and pose stay those of the depth camera. The defaults are those of a
    Kinect without registration, as in 7-Scenes.

    Attributes:
        focal_ratio: focal length of the colour camera over that of the depth camera; 1 = equal.
        baseline_m: position of the colour camera along the depth camera's x; 0 = same position.
        shift_x_px: pixels by which the colour image is too far to the right.
        shift_y_px: pixels by which it is too far down.
    """

    focal_ratio: float = bounded(525.0 / 585.0, 0.1, 10.0)
    baseline_m: float = bounded(0.025, -1.0, 1.0)
    shift_x_px: float = bounded(0.0, -1e4, 1e4)
    shift_y_px: float = bounded(0.0, -1e4, 1e4)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        K = optics.color
        color = dataclasses.replace(
            K,
            fx=K.fx * self.focal_ratio,
            fy=K.fy * self.focal_ratio,
            cx=K.cx + self.shift_x_px,
            cy=K.cy + self.shift_y_px,
        )
        offset = make_pose([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [self.baseline_m, 0.0, 0.0])
        return dataclasses.replace(optics, color=color, T_depth_color=optics.T_depth_color @ offset)


@dataclass(frozen=True)
class LensDistortion(Checked, OpticalPerturbation):
    """Lens distortion of both images, which are treated as pinhole images.

    Coefficients as in ``Distortion``. The defaults are about those of a wide-angle colour camera:
    barrel distortion of about two pixels in a corner at 160x120. All 0 = off.

    Attributes:
        k1: coefficient of r^2.
        k2: coefficient of r^4.
        p1: tangential coefficient, down.
        p2: tangential coefficient, across.
        k3: coefficient of r^6.
    """

    k1: float = bounded(-0.1, -0.4, 1.0)
    k2: float = bounded(0.03, -1.0, 1.0)
    p1: float = bounded(0.0, -0.1, 0.1)
    p2: float = bounded(0.0, -0.1, 0.1)
    k3: float = bounded(0.0, -1.0, 1.5)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        lens = Distortion.of("radial-tangential", [self.k1, self.k2, self.p1, self.p2, self.k3])
        return dataclasses.replace(optics, lens=lens)


def linear_of_srgb(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Convert sRGB values in [0, 1] to linear intensity in [0, 1] (IEC 61966-2-1)."""
    v = np.asarray(values, dtype=np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def srgb_of_linear(intensity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Invert ``linear_of_srgb``; intensities beyond [0, 1] saturate."""
    x = np.clip(np.asarray(intensity, dtype=np.float64), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


class LinearLight:
    """Averages colour images in linear light, as a sensor does."""

    def __init__(self, noise: NoiseConfig) -> None:
        """Set the intensity noise: variance = read^2 + shot * intensity."""
        self._noise = noise
        self._decode = linear_of_srgb(np.arange(256) / 255.0)

    def mean(self, colors: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
        """Average noise-free images (K, H, W, 3) of equal duration to one image (H, W, 3)."""
        light = self._decode[colors].mean(axis=0)
        sigma = np.sqrt(self._noise.read**2 + self._noise.shot * light)
        if sigma.any():
            light = light + sigma * rng.standard_normal(light.shape)
        return np.rint(255.0 * srgb_of_linear(light)).astype(np.uint8)


_STEP_S = 1e-3
_RAMP = 0.25  # share of a segment over which the speed rises, and falls again


@dataclass(frozen=True)
class FastMotion(Checked, MotionPerturbation):
    """Fast motion: the same path, in segments ``factor`` times as fast.

    The frame interval does not change, so the path has fewer frames. Speed rises and falls
    smoothly. Frames have the poses of the faster camera.

    Attributes:
        factor: speed factor in the middle of a segment; 1 = off.
        share: share of the time in fast segments.
        length_s: duration of a segment; shorter if the path is too short.
        seed: seed of the segments' starts, in addition to the sequence's.
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
        count = max(2, int(is_reached.sum()))  # progress increases, so these are the first ones
        return PoseInterpolation(path.times_s[:count], path(path.times_s[0] + progress[:count]))

    def progress(self, since_s: Float64, seed: int) -> Float64:
        """Position (N,) on the path, in seconds at the original pace, at times (N,) from 0 s."""
        dense = np.arange(0.0, since_s[-1] + 2 * _STEP_S, _STEP_S)
        pace = 1.0 + (self.factor - 1.0) * self._hurry(dense, seed)
        way = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) * _STEP_S)])
        return np.interp(since_s, dense, way)

    def _hurry(self, t: Float64, seed: int) -> Float64:
        """Speed profile: 0 outside the segments, 1 in their middle; one segment per period."""
        length = min(self.length_s, self.share * t[-1])  # a short path has a segment too
        period = length / self.share
        number = (t // period).astype(np.int64)
        rng = random_numbers(seed, self.seed, name="fast-motion")
        begins = rng.uniform(0.0, period - length, int(number[-1]) + 1)[number]
        along = (t - number * period - begins) / length  # 0 to 1 within the segment
        ramp = np.clip(np.minimum(along, 1.0 - along) / _RAMP, 0.0, 1.0)
        return ramp * ramp * (3.0 - 2.0 * ramp)


@dataclass(frozen=True)
class FrameSkipping(Checked, FrameSelection):
    """Keeps every n-th frame, and drops some of those at random; the first is always kept.

    Attributes:
        keep_every: n; 1 = all.
        lost: probability that a frame is lost.
        seed: seed of the losses, in addition to the sequence's.
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
