"""Smaller images of a camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SAME_SURFACE = 0.03  # of the depth; readings further apart are taken for different surfaces


def reduce_color(color: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Colour image at ``size`` (width, height): the mean of what each pixel covers."""
    return cv2.resize(color, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def reduce_depth(depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Depth image at ``size`` (width, height): the mean of the readings of one surface.

    The surface is that of the reading nearest to the centre of the pixels covered; readings that
    differ from it by more than 3 % are left out, so nothing is read between two surfaces. Without
    a reading there the pixel has none. A size that does not divide the image's takes the reading
    alone, because the pixels covered are then not the same number everywhere.
    """
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
