"""How frames are taken: rolling shutter, motion blur, and colour that is not registered."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Distortion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import make_pose
from ms_slam_env.sensor import NoiseConfig
from ms_slam_env.sequences.perturbations.base import OpticalPerturbation, Optics


@dataclass(frozen=True)
class RollingShutter(Checked, OpticalPerturbation):
    """Colour and depth are read row by row, from top to bottom, while the camera moves.

    Every two rows are rendered from the pose that the camera has at their own time. The time stamp,
    and with it the true pose, of a frame is that of the middle of the image.

    Attributes:
        readout_s: time from the first row to the last; 0 = off. The default is most of the time
            between two frames at 30 Hz.
    """

    readout_s: float = bounded(0.03, 0.0, 10.0)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        return dataclasses.replace(optics, readout_s=self.readout_s)


@dataclass(frozen=True)
class MotionBlur(Checked, OpticalPerturbation):
    """Colour is the mean of the linear light at instants spread over the exposure time.

    The exposure is centred on the time of the frame (of the row, if the shutter rolls). Depth,
    which is read from a projected pattern, is taken at the centre.

    Attributes:
        exposure_s: time over which light is gathered; 0 = off.
        samples: instants, evenly spaced.
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
    """Colour and depth, taken by two cameras, are handed on as if they were one image.

    The frame's intrinsics and pose stay those of the depth camera. The defaults are a Kinect's
    whose driver registers nothing, as in 7-Scenes.

    Attributes:
        focal_ratio: focal length of the colour camera over that of the depth camera; 1 = equal.
        baseline_m: the colour camera stands so far along the depth camera's x; 0 = at its place.
        shift_x_px: the colour image lies so many pixels too far to the right.
        shift_y_px: and so many too far down.
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
    """A lens bends both images, which are handed on as if they were a pinhole camera's.

    Coefficients as in ``Distortion``. The defaults are about those of a colour camera with a wide
    lens: barrel distortion of some two pixels in a corner at 160x120.

    Attributes:
        k1: of r^2,
        k2: of r^4,
        p1: tangential, down,
        p2: tangential, across,
        k3: of r^6; all 0 = off.
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
    """Linear intensity in [0, 1] of sRGB values in [0, 1] (IEC 61966-2-1)."""
    v = np.asarray(values, dtype=np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def srgb_of_linear(intensity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Invert ``linear_of_srgb``; intensities beyond [0, 1] saturate."""
    x = np.clip(np.asarray(intensity, dtype=np.float64), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


class LinearLight:
    """Averages colour images as a sensor gathers light."""

    def __init__(self, noise: NoiseConfig) -> None:
        """Take the noise of the intensity: variance = read^2 + shot * intensity."""
        self._noise = noise
        self._decode = linear_of_srgb(np.arange(256) / 255.0)

    def mean(self, colors: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
        """Image (H, W, 3) of noise-free images (K, H, W, 3) of equal duration."""
        light = self._decode[colors].mean(axis=0)
        sigma = np.sqrt(self._noise.read**2 + self._noise.shot * light)
        if sigma.any():
            light = light + sigma * rng.standard_normal(light.shape)
        return np.rint(255.0 * srgb_of_linear(light)).astype(np.uint8)
