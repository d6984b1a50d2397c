"""Observation variant ``features``: a compact vector."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, intensity_image
from ms_slam_env.env.observations.base import (
    NUM_STATE,
    Observation,
    RobotKnowledge,
    state_vector,
)

Float32 = NDArray[np.float32]

_GREY_BINS = 16
_ROWS, _COLUMNS = 6, 8
_DEPTH_SCALE_M = 4.0


def coarse_depth(depth: Float32) -> Float32:
    """Mean valid depth / 4 m and share of valid pixels in 6 x 8 cells, (96,) float32."""
    height, width = depth.shape
    rows = np.arange(_ROWS) * height // _ROWS
    columns = np.arange(_COLUMNS) * width // _COLUMNS
    valid = (depth > 0).astype(np.float32)
    total = np.add.reduceat(np.add.reduceat(depth, rows, axis=0), columns, axis=1)
    count = np.add.reduceat(np.add.reduceat(valid, rows, axis=0), columns, axis=1)
    cell = np.add.reduceat(np.add.reduceat(np.ones_like(valid), rows, axis=0), columns, axis=1)
    mean = total / np.maximum(count, 1) / _DEPTH_SCALE_M
    return np.concatenate([mean.ravel(), (count / cell).ravel()]).astype(np.float32)


class FeaturesObservation(Observation):
    """State vector (28), grey histogram (16), coarse depth (96), action mask (n): float32."""

    def __init__(self, intrinsics: Intrinsics, num_actions: int) -> None:
        size = NUM_STATE + _GREY_BINS + 2 * _ROWS * _COLUMNS + num_actions
        self.space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def build(self, knowledge: RobotKnowledge) -> Float32:
        """Return the vector."""
        grey = intensity_image(knowledge.frame.color)
        histogram = np.bincount(grey.ravel() // (256 // _GREY_BINS), minlength=_GREY_BINS)
        return np.concatenate(
            [
                state_vector(knowledge),
                histogram.astype(np.float32) / grey.size,
                coarse_depth(knowledge.frame.depth),
                knowledge.action_mask.astype(np.float32),
            ]
        )
