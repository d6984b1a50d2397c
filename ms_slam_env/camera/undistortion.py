"""Images of a camera with a lens, as the camera without it would have taken them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera.intrinsics import Intrinsics


def undistort_color(image: NDArray[np.uint8], intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """Colour (H, W, 3) as ``intrinsics.undistorted`` sees it, interpolated; black beyond the image.

    Raises:
        InputError: an image of another size than ``intrinsics`` say.
    """
    intrinsics.check_image(image, "colour")
    found = cv2.remap(image, *_maps(intrinsics), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return found.astype(np.uint8, copy=False)


def undistort_depth(image: NDArray[Any], intrinsics: Intrinsics) -> NDArray[Any]:
    """Depth (H, W), float32 or uint16, likewise: the nearest reading, 0 beyond the image.

    Depth is along the optical axis, which a lens leaves as it is.
    """
    intrinsics.check_image(image, "depth")
    return cv2.remap(image, *_maps(intrinsics), cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


@lru_cache(maxsize=8)
def _maps(intrinsics: Intrinsics) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row (H, W) where each pixel of the straight image is found in the bent one."""
    places = intrinsics.project(intrinsics.undistorted.rays()).astype(np.float32)
    return np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
