"""Pinhole intrinsics with optional lens distortion; pixel centres lie at integers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Integral, Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera.distortion import NO_DISTORTION, Distortion
from ms_slam_env.errors import InputError

XTION_SIZES: dict[str, tuple[int, int]] = {
    "80x60": (80, 60),
    "160x120": (160, 120),
    "320x240": (320, 240),
    "640x480": (640, 480),
}
"""Image sizes (width, height) of the simulated ASUS Xtion, by name."""

LARGEST_SIDE = 4096
"""Largest image side in pixels, more than any RGB-D camera has."""

SMALLEST_LEVEL = 2
"""Smallest side of a pyramid level in pixels: what interpolation needs."""

LARGEST_NUMBER = 1e6
"""Largest focal length and centre coordinate, pixels; the smallest focal length is its inverse."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: u = fx x / z + cx, v = fy y / z + cy, in pixels.

    With lens distortion, (x, y) / z is distorted first (`Distortion.distort`). SLAM and divergence
    need undistorted images (`ms_slam_env.camera.undistortion`); recordings are undistorted on
    reading.

    Raises:
        InputError: a side below 1 or above `LARGEST_SIDE` pixels, focal lengths or a centre that no
            camera has, or a distortion that folds the field of view.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion = NO_DISTORTION

    def __post_init__(self) -> None:
        """Refuse values that no camera has."""
        numbers = (self.fx, self.fy, self.cx, self.cy)
        for value in (*numbers, self.width, self.height):
            if not isinstance(value, Real) or isinstance(value, bool):
                raise InputError(f"intrinsics must be numbers, got {value!r}")
        if not isinstance(self.width, Integral) or not isinstance(self.height, Integral):
            raise InputError(f"image size {self.width}x{self.height} must be whole pixels")
        if not 1 <= min(self.width, self.height) <= max(self.width, self.height) <= LARGEST_SIDE:
            raise InputError(
                f"image size {self.width}x{self.height} must be at least 1x1 and at most "
                f"{LARGEST_SIDE}x{LARGEST_SIDE}"
            )
        if not all(abs(number) < math.inf for number in numbers) or min(self.fx, self.fy) <= 0:
            raise InputError(f"focal lengths and centre must be finite, fx, fy > 0: {numbers}")
        if min(self.fx, self.fy) < 1 / LARGEST_NUMBER or max(map(abs, numbers)) > LARGEST_NUMBER:
            raise InputError(
                f"focal lengths and centre must be at most {LARGEST_NUMBER:g} px, fx, fy at least "
                f"{1 / LARGEST_NUMBER:g} px: {numbers}"
            )
        if self.distortion:
            edges = np.linspace(0, self.width - 1, 17), np.linspace(0, self.height - 1, 17)
            grid = np.stack(np.meshgrid(*edges), axis=-1)
            if not self.distortion.is_one_to_one(self.undistorted.rays_at(grid)[..., :2]):
                raise InputError(f"{self.distortion} folds an image of {self.width}x{self.height}")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width), the shape of an image array."""
        return self.height, self.width

    @property
    def undistorted(self) -> Intrinsics:
        """The same camera without distortion."""
        return replace(self, distortion=NO_DISTORTION) if self.distortion else self

    @property
    def field(self) -> Float64:
        """Tangents (2, 2) of the view: x / z at left and right, y / z at top and bottom border.

        Those of a pinhole, rounded, so that an image has the same at every size of its shape.
        """
        middle = np.array([[self.cx], [self.cy]])
        borders = np.array([[-0.5, self.width - 0.5], [-0.5, self.height - 0.5]])
        return ((borders - middle) / [[self.fx], [self.fy]]).round(9)

    def check_pinhole(self, what: str) -> None:
        """Refuse lens distortion.

        Raises:
            InputError: ``what`` does not support it.
        """
        if self.distortion:
            raise InputError(
                f"{what} needs images without distortion, got {self.distortion}: straighten them "
                "with ms_slam_env.camera.undistortion and give intrinsics.undistorted"
            )

    def every_nth(self, n: int) -> Intrinsics:
        """Intrinsics after keeping every ``n``-th row and column, starting with the first.

        Raises:
            InputError: ``n`` below 1.
        """
        if n < 1:
            raise InputError(f"n = {n} must be >= 1")
        return replace(
            self,
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
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )

    def level_size(self, level: int) -> tuple[int, int]:
        """(width, height) of level ``level`` of an image pyramid; level 0 is the image itself.

        A pixel of a level is a whole 2x2 block of the level below; a leftover column or row at the
        right or bottom is dropped. All pyramids use this.

        Raises:
            InputError: a side of the level would be below `SMALLEST_LEVEL` pixels.
        """
        width, height = self.width >> level, self.height >> level
        if min(width, height) < SMALLEST_LEVEL:
            least = SMALLEST_LEVEL << level
            raise InputError(
                f"images of {self.width}x{self.height} are too small for a pyramid of {level + 1} "
                f"levels, which needs {least}x{least}"
            )
        return width, height

    def pyramid_level(self, level: int) -> Intrinsics:
        """Intrinsics of level ``level`` of a pyramid whose pixels are means of blocks.

        Raises:
            InputError: the image is too small for that level.
        """
        width, height = self.level_size(level)
        return replace(self.scaled(0.5**level), width=width, height=height)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the image resampled to ``width`` x ``height``, same field of view."""
        x, y = width / self.width, height / self.height
        centre = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return Intrinsics(self.fx * x, self.fy * y, *centre, width, height, self.distortion)

    def cropped(self, left: int, top: int, width: int, height: int) -> Intrinsics:
        """Intrinsics of the part of the image that starts at column ``left`` and row ``top``.

        Raises:
            InputError: the part is not inside the image.
        """
        fits = 0 <= left <= self.width - width and 0 <= top <= self.height - height
        if not fits:
            raise InputError(
                f"images of {self.width}x{self.height} have no part of {width}x{height} from "
                f"{left}, {top} on"
            )
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height)

    def rays(self) -> Float64:
        """Viewing rays (height, width, 3) in the camera frame with z = 1."""
        v, u = np.mgrid[: self.height, : self.width].astype(np.float64)
        return self.rays_at(np.stack([u, v], axis=-1))

    def rays_at(self, pixels: ArrayLike) -> Float64:
        """Viewing rays (..., 3) with z = 1 through pixels (..., 2), the inverse of ``project``.

        Raises:
            InputError: a pixel has no ray in front of the camera under this distortion.
        """
        u, v = np.moveaxis(np.asarray(pixels, dtype=np.float64), -1, 0)
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        if self.distortion:
            x, y = np.moveaxis(self.distortion.undistort(np.stack([x, y], axis=-1)), -1, 0)
        return np.stack([x, y, np.ones_like(u)], -1)

    @property
    def matrix(self) -> Float64:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> Float64:
        """Pixel coordinates (..., 2) of points (..., 3) in the camera frame with z > 0."""
        p = np.asarray(points, dtype=np.float64)
        if self.distortion:
            bent = self.distortion.distort(p[..., :2] / p[..., 2:])
            return bent * (self.fx, self.fy) + (self.cx, self.cy)
        u = self.fx * p[..., 0] / p[..., 2] + self.cx
        v = self.fy * p[..., 1] / p[..., 2] + self.cy
        return np.stack([u, v], axis=-1)

    def check_image(self, image: NDArray[np.generic], name: str) -> None:
        """Refuse an image whose height and width differ from the intrinsics.

        Raises:
            InputError: it names both sizes.
        """
        if image.shape[:2] != self.shape:
            raise InputError(
                f"{name} is {image.shape[1]}x{image.shape[0]} but the intrinsics say "
                f"{self.width}x{self.height}"
                if image.ndim >= 2
                else f"{name} must be an image, got shape {image.shape}"
            )
