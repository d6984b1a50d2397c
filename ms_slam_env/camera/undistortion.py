"""Undistortion of colour and depth images."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera.intrinsics import Intrinsics


def undistort_color(image: NDArray[np.uint8], intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """Undistort colour (H, W, 3) by interpolation; black outside the image.

    The result belongs to ``intrinsics.undistorted``.

    Raises:
        InputError: the image's size differs from ``intrinsics``.
    """
    intrinsics.check_image(image, "colour")
    found = cv2.remap(image, *_maps(intrinsics), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return found.astype(np.uint8, copy=False)


def undistort_depth(image: NDArray[Any], intrinsics: Intrinsics) -> NDArray[Any]:
    """Undistort depth (H, W), float32 or uint16, by nearest reading; 0 outside the image.

    Values do not change, because depth is measured along the optical axis.
    """
    intrinsics.check_image(image, "depth")
    return cv2.remap(image, *_maps(intrinsics), cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


@lru_cache(maxsize=8)
def _maps(intrinsics: Intrinsics) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row (H, W) of each undistorted pixel in the distorted image."""
    places = intrinsics.project(intrinsics.undistorted.rays()).astype(np.float32)
    return np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
