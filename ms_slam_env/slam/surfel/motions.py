"""Motions from frame to frame: what they are worth, and how they are predicted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import se3_exp, se3_log
from ms_slam_env.slam.base import Float64

DECAY = 0.9  # from frame to frame, of a motion that is predicted only


def damped(motion: Float64) -> Float64:
    """A motion (4, 4) slowed down a little."""
    return se3_exp(DECAY * se3_log(motion))


def motion_weight(motions: Float64) -> NDArray[np.float32]:
    """Weights (B,) in [0.5, 1] of frames reached by ``motions`` (B, 4, 4).

    Readings of a fast camera are blurred and skewed; 1 at rest, 0.5 from 0.1 m or 0.1 rad a frame.
    """
    distance = np.linalg.norm(motions[:, :3, 3], axis=1)
    cosine = (np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    size = np.maximum(distance, np.arccos(np.clip(cosine, -1, 1)))
    return np.maximum(0.5, 1 - size / 0.2).astype(np.float32)
