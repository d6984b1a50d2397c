"""ORB features of a frame with their depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.shared.rows import Rows

SCALE = 1.2  # between levels of the pyramid, as in ORB-SLAM
_EDGE_PX = 8  # margin of the magnified image; ORB itself extends the image by reflection
_CANDIDATES = 2  # corners detected per corner kept
_CELLS = (8, 6)  # grid across and down; each cell keeps the same number of corners
_SLOPE_PX = 2.0  # half the distance over which a slope is measured
_EDGE_PER_M = 0.03  # step of inverse depth between neighbours that marks an edge, 1/m


@dataclass(frozen=True)
class Features(Rows):
    """Features of one image."""

    pixels: Float64  # (N, 2) float64 positions (u, v)
    inverse_depth: Float64  # (N,) float64, 1/m; 0 = not known
    descriptors: NDArray[np.uint64]  # (N, 4) uint64, the 256 bits of ORB
    # (N,) float64 relative error of the position, 1 for a corner of the full image: size of a pixel
    # of the pyramid level it was found on, in pixels of the image.
    scale: Float64

    def points(self, intrinsics: Intrinsics) -> Float64:
        """Points (N, 3) in the camera frame; NaN where the depth is not known."""
        known = self.inverse_depth > 0
        depth = np.where(known, 1.0 / np.where(known, self.inverse_depth, 1.0), np.nan)
        return intrinsics.rays_at(self.pixels) * depth[:, None]


_FAST_THRESHOLD = 7  # least contrast of a corner, grey levels
_DETECTION_WIDTH = 320
"""Smaller images are magnified to this width before detection.

ORB describes a patch of 31 pixels, a fifth of an image 160 pixels wide.
"""


class FeatureExtractor:
    """Detects and describes corners evenly over the image; for options see ``SparseConfig``."""

    def __init__(self, intrinsics: Intrinsics, features: int = 600, levels: int = 4) -> None:
        self._count = features
        self._shape = intrinsics.shape
        self._magnify = max(1, round(_DETECTION_WIDTH / intrinsics.width))
        self._orb = cv2.ORB.create(
            nfeatures=_CANDIDATES * features,
            scaleFactor=SCALE,
            nlevels=levels,
            edgeThreshold=_EDGE_PX,
            fastThreshold=_FAST_THRESHOLD,
        )

    def __call__(self, grey: NDArray[np.uint8], inverse_depth: InverseDepth) -> Features:
        """Extract the features of an image (H, W) uint8 with its inverse depth."""
        n = self._magnify
        size = (n * grey.shape[1], n * grey.shape[0])
        image = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC) if n > 1 else grey
        found = self._spread(self._orb.detect(image, None))
        found, described = self._orb.compute(image, found)
        if described is None or len(found) == 0:
            none = np.zeros(0)
            return Features(np.zeros((0, 2)), none, np.zeros((0, 4), dtype=np.uint64), none)
        # A pixel of the image covers n x n of the magnified one; centres lie at integers.
        corners = np.asarray(cv2.KeyPoint.convert(found), dtype=np.float64)
        pixels = (corners + 0.5) / n - 0.5
        scale = SCALE ** np.array([corner.octave for corner in found], dtype=np.float64)
        return Features(
            pixels,
            inverse_depth.at(pixels),
            np.ascontiguousarray(described).view(np.uint64),
            np.maximum(scale / n, 1.0),
        )

    def _spread(self, corners: Sequence[cv2.KeyPoint]) -> Sequence[cv2.KeyPoint]:
        """Select the strongest corners of every cell of the image, ``features`` in all."""
        if len(corners) <= self._count:
            return corners
        across, down = _CELLS
        size = np.array([self._shape[1], self._shape[0]]) * self._magnify
        cell = (np.asarray(cv2.KeyPoint.convert(corners)) / size * [across, down]).astype(np.int64)
        cell_of = cell[:, 1] * across + cell[:, 0]
        strength = np.array([corner.response for corner in corners])
        order = np.lexsort((-strength, cell_of))
        first = np.searchsorted(cell_of[order], np.arange(across * down))
        rank = np.empty(len(corners), dtype=np.int64)
        rank[order] = np.arange(len(corners)) - first[cell_of[order]]
        kept = np.sort(np.argsort(rank, kind="stable")[: self._count])
        return [corners[index] for index in kept]


class InverseDepth:
    """Inverse depth of an image, smoothed over 3x3 pixels, with subpixel lookup.

    The inverse depth of a plane is linear in the image, so the mean equals the centre's value.

    Args:
        depth: (H, W) float32 metres; 0 = no reading.
    """

    def __init__(self, depth: Float32) -> None:
        known = (depth > 0).astype(np.float32)
        inverse = np.divide(known, depth, out=np.zeros_like(known), where=depth > 0)
        border = cv2.BORDER_CONSTANT
        count = cv2.boxFilter(known, -1, (3, 3), normalize=False, borderType=border)
        total = cv2.boxFilter(inverse, -1, (3, 3), normalize=False, borderType=border)
        kernel = np.ones((3, 3), dtype=np.uint8)
        largest = cv2.dilate(inverse, kernel)
        smallest = cv2.erode(np.where(depth > 0, inverse, np.float32(1e3)), kernel)
        smooth = (count >= 5) & (largest - smallest < 2 * _EDGE_PER_M)
        self._mean = np.where(smooth, total / np.maximum(count, 1), np.float32(0))
        self._smooth = smooth.astype(np.float32)

    def at(self, pixels: Float64) -> Float64:
        """Inverse depth (N,) in 1/m at pixels (N, 2); 0 at edges and holes."""
        if len(pixels) == 0:
            return np.zeros(0)
        u, v = pixels.astype(np.float32).T[:, None]
        border = cv2.BORDER_REPLICATE
        value = cv2.remap(self._mean, u, v, cv2.INTER_LINEAR, borderMode=border)[0]
        whole = cv2.remap(self._smooth, u, v, cv2.INTER_LINEAR, borderMode=border)[0]
        return np.where(whole > 0.999, value, 0.0).astype(np.float64)

    def slope(self, pixels: Float64) -> Float64:
        """Change (N, 2) of inverse depth from pixel to pixel, across and down; 0 at edges."""
        slopes = []
        for step in np.eye(2) * _SLOPE_PX:
            before, after = self.at(pixels - step), self.at(pixels + step)
            known = (before > 0) & (after > 0)
            slopes.append(np.where(known, after - before, 0.0) / (2 * _SLOPE_PX))
        return np.stack(slopes, axis=1)
