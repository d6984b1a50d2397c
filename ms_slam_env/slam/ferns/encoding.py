"""Frames as codes of binary tests at random places.

Glocker, Shotton, Criminisi, Izadi, "Real-Time RGB-D Camera Relocalization via Randomized Ferns for
Keyframe Encoding", TVCG 2015: each fern compares red, green, blue and depth at one
place of a small, smoothed image with a threshold each.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.ferns.config import FernConfig

UInt8 = NDArray[np.uint8]
Float64 = NDArray[np.float64]

COLOUR_BITS = 7  # red 1, green 2, blue 4
DEPTH_BIT = 8
MEAN_LEVEL = 128.0  # frames are made this bright, on average, before they are tested
_THRESHOLDS = (32.0, 224.0)  # on colours, after that
_AVERAGED = 8  # rows and columns of the image, at least, that a reduced pixel is the mean of


@dataclass(frozen=True)
class FernCode:
    """The code of one frame.

    Attributes:
        bits: (F,) outcome of the four tests of each fern.
        known: (F,) which of the four bits could be tested; depth cannot where it has no reading.
    """

    bits: UInt8
    known: UInt8


class FernEncoder:
    """Encodes frames of one camera; places and thresholds are drawn from a seed."""

    def __init__(self, intrinsics: Intrinsics, config: FernConfig, seed: int = 0) -> None:
        """Draw the ferns."""
        rng = np.random.default_rng(seed)
        height, width = intrinsics.shape
        columns = min(config.columns, width)
        rows = max(1, round(height * columns / width))
        self._size = (columns, rows)
        self._step = max(1, min(height // rows, width // columns) // _AVERAGED)
        self._blur_px = config.blur_px
        column = rng.integers(0, columns, config.num_ferns)
        row = rng.integers(0, rows, config.num_ferns)
        self.color_thresholds: Float64 = rng.uniform(*_THRESHOLDS, (config.num_ferns, 3))
        self.depth_thresholds: Float64 = rng.uniform(config.near_m, config.far_m, config.num_ferns)
        self._color_place = row * columns + column
        # Depth is not averaged: a mean across an edge is no surface's depth.
        v = ((row + 0.5) * height / rows).astype(np.int64)
        u = ((column + 0.5) * width / columns).astype(np.int64)
        self._depth_place = v * width + u

    @property
    def tested_size(self) -> tuple[int, int]:
        """Width and height of the reduced image that is tested."""
        return self._size

    def encode(self, color: UInt8, depth: NDArray[np.float32]) -> FernCode:
        """Code of a frame: colour (H, W, 3) uint8, depth (H, W) metres, 0 = no reading.

        Colours are divided by the frame's mean brightness: a change of exposure changes no bit,
        but where it saturates.
        """
        thinned = np.ascontiguousarray(color[:: self._step, :: self._step])
        small = cv2.resize(thinned, self._size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), self._blur_px)
        tested = small.reshape(-1, 3)[self._color_place]
        brightness = max(float(np.mean(small)), 1.0)
        above = tested > self.color_thresholds * (brightness / MEAN_LEVEL)
        reading = depth.reshape(-1)[self._depth_place]
        bits = above @ np.array([1, 2, 4], dtype=np.uint8)
        bits |= (reading > self.depth_thresholds).astype(np.uint8) << 3
        known = np.where(reading > 0, COLOUR_BITS | DEPTH_BIT, COLOUR_BITS).astype(np.uint8)
        return FernCode(bits, known)


def dissimilarities(code: FernCode, bits: UInt8, known: UInt8) -> Float64:
    """Share of ferns (K,) at which ``code`` differs from each of K codes (K, F).

    The paper's block-wise Hamming distance: a fern differs if any of its bits does.
    Bits that either frame does not know are left out.
    """
    different = (bits ^ code.bits) & (known & code.known)
    return np.count_nonzero(different, axis=1) / different.shape[1]
