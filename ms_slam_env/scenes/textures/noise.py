"""Tileable random fields with power-law spectra, the raw material of every texture.

Natural images have amplitude spectra close to 1/f (Field, J. Opt. Soc. Am. A 4, 1987); so do
surfaces made from these fields.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ms_slam_env._runtime.arrays import Image
from ms_slam_env.scenes.scene import Rng

Field = NDArray[np.float32]

_VARIANTS = 3
_CLIP = 3.0


@lru_cache(maxsize=48)
def _base_field(height: int, width: int, exponent: float, stretch: float, index: int) -> Field:
    """A field of zero mean and unit deviation; a few are made, and then shifted and flipped."""
    rng = np.random.default_rng([height, width, int(100 * exponent), int(100 * stretch), index])
    # In cycles per longer side of the image, so that a wide image has no wider features.
    longest = max(height, width)
    fy = fft.fftfreq(height)[:, None] * longest
    fx = fft.rfftfreq(width)[None, :] * longest * stretch
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    white = rng.standard_normal((height, width), dtype=np.float32)
    field = fft.irfft2(fft.rfft2(white) / radius.astype(np.float32) ** exponent, (height, width))
    field = np.clip(field / field.std(), -_CLIP, _CLIP).astype(np.float32)
    field.setflags(write=False)
    return field


def noise(rng: Rng, shape: tuple[int, int], exponent: float = 1.0, stretch: float = 1.0) -> Field:
    """Tileable noise (h, w) of unit deviation with amplitude spectrum 1 / f^exponent.

    ``stretch`` > 1 makes features that many times longer along x, the direction of columns.
    """
    base = _base_field(*shape, exponent, stretch, int(rng.integers(_VARIANTS)))
    shift = (int(rng.integers(shape[0])), int(rng.integers(shape[1])))
    flip = slice(None, None, -1) if rng.random() < 0.5 else slice(None)
    return np.roll(base[flip], shift, (0, 1))


def shade(rgb: ArrayLike, *variations: tuple[float, Field]) -> Image:
    """Lighten and darken the colour(s) ``rgb`` (3,) or (h, w, 3) in [0, 255] by the fields."""
    factor: Field = np.ones((), np.float32)
    for amount, field in variations:
        factor = factor + np.float32(amount) * field
    image = np.asarray(rgb, dtype=np.float32) * np.asarray(factor)[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)


def grain(
    rng: Rng, rgb: ArrayLike, shape: tuple[int, int], *variations: tuple[float, ...]
) -> Image:
    """:func:`shade` with noise fields (h, w), given the amount, exponent and stretch of each."""
    return shade(rgb, *((amount, noise(rng, shape, *how)) for amount, *how in variations))


def write(
    image: NDArray,
    text: str,
    at: tuple[int, int],
    style: tuple[int, float, int],
    rgb: ArrayLike,
    line: int = cv2.LINE_8,
) -> None:
    """Write text on an image (h, w, 3) in place; ``style`` is OpenCV font, scale, thickness."""
    mask = np.zeros(image.shape[:2], np.uint8)  # text is drawn on 8 bits only
    cv2.putText(mask, text, at, style[0], style[1], 255, style[2], line)
    image[mask > 96] = rgb


def hsv(hue: float, saturation: float, value: float) -> NDArray[np.float64]:
    """SRGB colour (3,) in [0, 255] of hue (in turns), saturation and value in [0, 1]."""
    k = (np.array([5.0, 3.0, 1.0]) + hue * 6.0) % 6.0
    chroma = np.clip(np.minimum(k, 4.0 - k), 0.0, 1.0)
    return 255.0 * value * (1.0 - saturation * chroma)
