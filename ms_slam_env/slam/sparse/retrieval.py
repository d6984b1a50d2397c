"""Which keyframes look like an image: small, blurred pictures compared by correlation."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ms_slam_env.slam.alignment_check import DepthImage
from ms_slam_env.slam.base import Float32

_SIZE = (16, 12)  # of a thumbnail, pixels


def thumbnail(image: DepthImage) -> Float32:
    """Unit vector (D,) of an image's looks: its brightness and its nearness, coarsely."""
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
    """Indices of the ``count`` thumbnails that resemble one most, best first."""
    if not len(others):
        return []
    scores = np.stack(others) @ wanted
    return [int(index) for index in np.argsort(-scores, kind="stable")[:count]]
