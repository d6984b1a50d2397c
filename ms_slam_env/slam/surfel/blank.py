"""Black and blank frames: a shutter, a dropped frame, glare; there is nothing to track in them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]

BLANK = 100
"""Code of the verdict on such a frame."""
REASON = "the image is black or blank"

_EVERY = 4  # rows and columns that are looked at
_CONSTANT = 0.5  # largest standard deviation of an image that no sensor took, grey levels
_DARK, _BRIGHT = 16.0, 240.0  # means below and above which an image
_FAINT = 4.0  # of at most this standard deviation is black or glare


def is_blank(color: NDArray[np.uint8]) -> Bool:
    """Which images (B, H, W, 3) show nothing: one colour throughout, or black, or glare.

    A plain wall is neither: its image has the sensor's noise and a middling brightness.
    """
    # Image by image OpenCV takes a tenth of the time of NumPy's sums over the whole batch.
    sampled = np.ascontiguousarray(color[:, ::_EVERY, ::_EVERY])
    statistics = np.array([cv2.meanStdDev(image) for image in sampled])  # (B, 2, 3, 1)
    mean = statistics[:, 0].mean(axis=(1, 2))
    spread = statistics[:, 1].max(axis=(1, 2))
    extreme = (mean < _DARK) | (mean > _BRIGHT)
    return (spread < _CONSTANT) | (extreme & (spread < _FAINT))


class BlankFrames:
    """Tells the blank frames of B envs, where frames are not always so.

    Recordings without colour have blank images from the first frame on.
    """

    def __init__(self, batch: int) -> None:
        """Expect images."""
        self.colorless = np.zeros(batch, dtype=bool)

    def find(self, color: NDArray[np.uint8], started: Bool) -> Bool:
        """Which frames (B, H, W, 3) are blank; the first of an env says whether it has colour."""
        blank = is_blank(color)
        self.colorless = np.where(started, self.colorless, blank)
        return blank & ~self.colorless
