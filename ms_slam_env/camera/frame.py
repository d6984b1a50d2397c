"""RGB-D frames, and reduction of their images."""

from __future__ import annotations

import numbers
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera.intrinsics import Intrinsics
from ms_slam_env.errors import InputError

_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


@dataclass(frozen=True)
class RGBDFrame:
    """Registered colour and depth of one instant.

    Attributes:
        color: (H, W, 3) uint8, RGB.
        depth: (H, W) float32, metres along the optical axis; 0 = no reading.
        timestamp: seconds.

    Raises:
        InputError: wrong shapes or types, NaN, infinite or negative depth.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    timestamp: float = 0.0

    def __post_init__(self) -> None:
        """Refuse invalid frames, which would corrupt later steps."""
        for name in ("color", "depth"):
            if not isinstance(getattr(self, name), np.ndarray):
                kind = type(getattr(self, name)).__name__
                raise InputError(f"{name} must be an array, got a {kind}")
        if not isinstance(self.timestamp, numbers.Real):
            raise InputError(f"timestamp = {self.timestamp!r} must be a number of seconds")
        if self.color.ndim != 3 or self.color.shape[2] != 3 or self.color.dtype != np.uint8:
            raise InputError(
                f"color must be (H, W, 3) uint8, got {self.color.shape} {self.color.dtype}"
            )
        if self.depth.ndim != 2 or self.depth.shape != self.color.shape[:2]:
            raise InputError(
                f"depth must have the shape of color {self.color.shape[:2]}, got {self.depth.shape}"
            )
        if not np.issubdtype(self.depth.dtype, np.floating):
            raise InputError(f"depth must be float metres, got {self.depth.dtype}")
        check_readings(self.depth)


def check_camera(intrinsics: object) -> None:
    """Refuse anything but a camera.

    Raises:
        InputError: it names the type.
    """
    if not isinstance(intrinsics, Intrinsics):
        raise InputError(f"a camera must be an Intrinsics, got a {type(intrinsics).__name__}")


def check_frame(frame: object, intrinsics: Intrinsics) -> None:
    """Refuse anything but a frame of this camera.

    Raises:
        InputError: it names the type, or both sizes.
    """
    if not isinstance(frame, RGBDFrame):
        raise InputError(f"a frame must be an RGBDFrame, got a {type(frame).__name__}")
    intrinsics.check_image(frame.depth, "frame")


def check_readings(depth: NDArray[np.floating]) -> None:
    """Refuse invalid depth, which would corrupt later steps.

    Raises:
        InputError: NaN, infinite or negative depth.
    """
    if not np.isfinite(depth).all():
        raise InputError("depth holds NaN or infinite values; 0 means no reading")
    if (depth < 0).any():
        raise InputError("depth holds negative values; 0 means no reading")


def intensity_image(image: ArrayLike) -> NDArray[np.uint8]:
    """Convert a colour image (H, W, 3) uint8 to grey (H, W) uint8 (BT.601); grey passes through.

    Raises:
        InputError: a wrong shape or type.
    """
    try:
        array = np.asarray(image)
    except ValueError:  # rows of different lengths
        raise InputError("an image must be an array") from None
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise InputError(f"an image must be (H, W) or (H, W, 3), got {array.shape}")
    if array.dtype != np.uint8:
        raise InputError(f"an image must be uint8, got {array.dtype}")
    if array.ndim == 2:
        return array
    return np.rint(array.astype(np.float32) @ _LUMA).astype(np.uint8)


_SAME_SURFACE = 0.03  # relative depth difference above which readings are different surfaces


def reduce_color(color: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Reduce colour to ``size`` (width, height): each pixel is the mean of what it covers."""
    import cv2

    return cv2.resize(color, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def reduce_depth(depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Reduce depth to ``size`` (width, height): each pixel is the mean over one surface.

    The surface is that of the covered pixel nearest to their centre. Readings that differ from it
    by more than 3 % are left out, so none falls between two surfaces. If that pixel has no reading,
    neither has the result. If ``size`` does not divide the image's, that reading alone is used,
    because the number of covered pixels then varies.
    """
    import cv2

    width, height = size
    centre = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    rows, columns = depth.shape[0] // height, depth.shape[1] // width
    if (rows * height, columns * width) != depth.shape:
        return centre.astype(np.float32, copy=False)
    total = np.zeros_like(centre)
    count = np.zeros_like(centre)
    tolerance = _SAME_SURFACE * centre
    for row in range(rows):
        for column in range(columns):
            part = depth[row::rows, column::columns]
            is_same = (part > 0) & (np.abs(part - centre) <= tolerance)
            total += np.where(is_same, part, 0)
            count += is_same
    return np.where(centre > 0, total / np.maximum(count, 1), 0).astype(np.float32)
