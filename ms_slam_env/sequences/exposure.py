"""Light gathered over an exposure: the mean of images in linear intensity, and its noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.sensor import NoiseConfig


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
