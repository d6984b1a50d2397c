"""Pinhole intrinsics; pixel centres lie at integers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError, unknown

Array = NDArray[np.float64]

XTION_SIZES: dict[str, tuple[int, int]] = {
    "80x60": (80, 60),
    "160x120": (160, 120),
    "320x240": (320, 240),
    "640x480": (640, 480),
}
"""Image sizes of the simulated ASUS Xtion, name to (width, height)."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: u = fx x / z + cx, v = fy y / z + cy, in pixels.

    Raises:
        InputError: a size below 1 or a focal length that is not positive and finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        """Refuse values that no camera has."""
        if self.width < 1 or self.height < 1:
            raise InputError(f"image size {self.width}x{self.height} must be at least 1x1")
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(number) for number in numbers) or min(self.fx, self.fy) <= 0:
            raise InputError(f"focal lengths and centre must be finite, fx, fy > 0: {numbers}")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image array."""
        return self.height, self.width

    def every_nth(self, n: int) -> Intrinsics:
        """Intrinsics of the image that keeps every ``n``-th row and column, from the first on.

        Raises:
            InputError: ``n`` below 1.
        """
        if n < 1:
            raise InputError(f"n = {n} must be >= 1")
        return Intrinsics(
            fx=self.fx / n,
            fy=self.fy / n,
            cx=self.cx / n,
            cy=self.cy / n,
            width=-(-self.width // n),
            height=-(-self.height // n),
        )

    def scaled(self, factor: float) -> Intrinsics:
        """Intrinsics of the image resampled by ``factor`` (0.5 halves it), same field of view.

        Pixel centres at integers make the image span [-0.5, width - 0.5], hence the half pixels.
        """
        return Intrinsics(
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )

    def rays(self) -> Array:
        """Viewing rays (height, width, 3) in the camera frame with z = 1."""
        v, u = np.mgrid[: self.height, : self.width].astype(np.float64)
        return self.rays_at(np.stack([u, v], axis=-1))

    def rays_at(self, pixels: ArrayLike) -> Array:
        """Viewing rays (..., 3) with z = 1 through pixels (..., 2), the inverse of ``project``."""
        u, v = np.moveaxis(np.asarray(pixels, dtype=np.float64), -1, 0)
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], -1)

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> Array:
        """Pixel coordinates (..., 2) of points (..., 3) of the camera frame with z > 0."""
        p = np.asarray(points, dtype=np.float64)
        u = self.fx * p[..., 0] / p[..., 2] + self.cx
        v = self.fy * p[..., 1] / p[..., 2] + self.cy
        return np.stack([u, v], axis=-1)

    def check_image(self, image: NDArray[np.generic], name: str) -> None:
        """Refuse an image whose height and width differ from the intrinsics.

        Raises:
            InputError: naming both sizes.
        """
        if image.shape[:2] != self.shape:
            raise InputError(
                f"{name} is {image.shape[1]}x{image.shape[0]} but the intrinsics say "
                f"{self.width}x{self.height}"
                if image.ndim >= 2
                else f"{name} must be an image, got shape {image.shape}"
            )


def xtion(size: str = "160x120") -> Intrinsics:
    """Intrinsics of the ASUS Xtion Pro Live, scaled to ``size``.

    570.3 px at 640x480 is the focal length of the OpenNI driver's default calibration
    (58 x 45 degrees field of view).

    Raises:
        InputError: unknown size.
    """
    if size not in XTION_SIZES:
        raise unknown("image size", size, XTION_SIZES)
    full = Intrinsics(fx=570.3, fy=570.3, cx=319.5, cy=239.5, width=640, height=480)
    return full.scaled(XTION_SIZES[size][0] / full.width)
