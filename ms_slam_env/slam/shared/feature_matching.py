"""Matches ORB descriptors, near an expected position or anywhere, and whole images."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float32, Float64, Int64
from ms_slam_env.slam.shared.alignment_measures import DepthImage

Descriptors = NDArray[np.uint64]

_NEIGHBOURS = 8  # most features compared with a projected point
_RATIO = 0.9  # the best match must be this much better than the second best
_SIZE = (16, 12)  # of a thumbnail, pixels


def hamming_distance(a: Descriptors, b: Descriptors) -> Int64:
    """Differing bits (...,) of descriptors (..., 4)."""
    return np.bitwise_count(a ^ b).sum(axis=-1, dtype=np.int64)


def match_near(
    projected: Float64,
    wanted: Descriptors,
    tree: cKDTree,
    descriptors: Descriptors,
    radius_px: float,
    hamming: int,
) -> tuple[Int64, Int64]:
    """Match points with features near their projections.

    Args:
        projected: (P, 2) pixels.
        wanted: (P, 4) descriptors of the points.
        tree: k-d tree of the features' pixels.
        descriptors: (N, 4) of the features.
        radius_px: features farther away are not compared.
        hamming: largest Hamming distance of a match.

    Returns:
        Indices (M,) of points and of their matching features; each occurs once.
    """
    if len(projected) == 0 or len(descriptors) == 0:
        return _no_match()
    count = min(_NEIGHBOURS, len(descriptors))
    _, near = tree.query(projected, k=count, distance_upper_bound=radius_px)
    near = near.reshape(len(projected), count)
    is_feature = near < len(descriptors)
    distance = np.full(near.shape, 257, dtype=np.int64)
    point, column = np.nonzero(is_feature)
    distance[point, column] = hamming_distance(wanted[point], descriptors[near[point, column]])
    best = distance.argmin(axis=1)
    rows = np.arange(len(projected))
    least = distance[rows, best]
    distance[rows, best] = 257
    second = distance.min(axis=1)
    good = np.flatnonzero((least <= hamming) & (least < _RATIO * second))
    return _one_to_one(good, near[good, best[good]], least[good])


def match_anywhere(a: Descriptors, b: Descriptors, hamming: int) -> tuple[Int64, Int64]:
    """Indices (M,), (M,) of descriptors (N, 4) and (K, 4) that are each other's best match."""
    if len(a) == 0 or len(b) == 0:
        return _no_match()
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    found = [
        (match.queryIdx, match.trainIdx)
        for match in matcher.match(a.view(np.uint8), b.view(np.uint8))
        if match.distance <= hamming
    ]
    pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _one_to_one(points: Int64, features: Int64, distance: Int64) -> tuple[Int64, Int64]:
    """Assign each feature only to its most similar point."""
    order = np.lexsort((points, distance))
    _, first = np.unique(features[order], return_index=True)
    kept = np.sort(order[first])
    return points[kept], features[kept]


def _no_match() -> tuple[Int64, Int64]:
    return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)


def thumbnail(image: DepthImage) -> Float32:
    """Reduce an image to a unit vector (D,) of coarse brightness and inverse depth."""
    depth = image.depth
    nearness = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    parts = []
    for picture in (image.intensity, nearness):
        small = cv2.resize(picture, _SIZE, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), 1.0)
        small = small - small.mean()
        parts.append(small.ravel() / max(float(np.linalg.norm(small)), 1e-6))
    return np.concatenate(parts).astype(np.float32) / np.float32(np.sqrt(2.0))


def most_alike(wanted: Float32, others: Sequence[Float32], count: int) -> list[int]:
    """Indices of the ``count`` most similar thumbnails, best first."""
    if not len(others):
        return []
    scores = np.stack(others) @ wanted
    return [int(index) for index in np.argsort(-scores, kind="stable")[:count]]
