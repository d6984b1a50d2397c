"""Pieces of a depth image that hang together, and what most of their pixels say."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
_FROM = {0: np.s_[:-1, :], 1: np.s_[:, :-1]}  # pixels with a neighbour below, or to the right
_TO = {0: np.s_[1:, :], 1: np.s_[:, 1:]}


class Pieces:
    """Connected pieces of a depth image, cut at steps of inverse depth and at creases.

    Attributes:
        labels: (h, w) number of the piece; 0 for the seams.
        count: of the labels, 0 included.
    """

    def __init__(
        self, depth: Float32, normals: Float32, largest_step: float, least_cosine: float
    ) -> None:
        """Cut the image.

        Args:
            depth: (h, w) metres, 0 = no reading.
            normals: (h, w, 3) unit vectors; 0 = none.
            largest_step: of inverse depth between neighbours, 1/m.
            least_cosine: of the angle between their normals.
        """
        is_inner = depth > 0
        inverse = np.where(is_inner, 1.0 / np.where(is_inner, depth, 1.0), -np.inf)
        for axis in (0, 1):
            a, b = _FROM[axis], _TO[axis]
            is_joined = np.abs(inverse[a] - np.maximum(inverse[b], -1e6)) < largest_step
            cosine = np.einsum("hwc,hwc->hw", normals[a], normals[b])
            is_inner[a] &= is_joined & (cosine > least_cosine)
        count, labels = cv2.connectedComponents(is_inner.astype(np.uint8), connectivity=4)
        self.count, self.labels = count, np.asarray(labels)

    def number(self, where: Bool) -> NDArray[np.int64]:
        """(count,) pixels of each piece that are set in (h, w)."""
        return np.bincount(self.labels[where], minlength=self.count)

    def where(self, votes: Bool, against: Bool, share: float, least: NDArray[np.float64]) -> Bool:
        """Pixels (h, w) of the pieces that are voted for.

        Args:
            votes: (h, w) for.
            against: (h, w), unless they vote for.
            share: of both that must be for.
            least: (count,) votes, more than which there must be.
        """
        own, others = self.number(votes), self.number(against & ~votes)
        chosen = (own > share * (own + others)) & (own > least)
        chosen[0] = False
        return chosen[self.labels]

    def filled(self, values: Float32, limit: float) -> Float32:
        """Values (h, w); where more than half of a piece is above a limit, no less than their mean.

        So the parts of a thing that come into view are taken for what the rest of it is.
        """
        is_above = values > limit
        above, all_pixels = self.number(is_above), np.bincount(self.labels.ravel())
        weights = np.where(is_above, values, 0.0).ravel()
        mean = np.bincount(self.labels.ravel(), weights) / np.maximum(above, 1)
        mean[(above <= 0.5 * all_pixels) | (np.arange(self.count) == 0)] = -np.inf
        return np.maximum(values, mean[self.labels]).astype(np.float32)
