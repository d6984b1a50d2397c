"""How right a closed loop is: where it puts the camera against where the old map says it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import Float64, invert, relative_angle

WRONG_M, WRONG_DEG = 0.05, 3.0
"""A closure is wrong if it leaves new and old map further apart than this."""


@dataclass(frozen=True)
class Closure:
    """One closed loop: how far new and old map were apart before and after, and when."""

    frame: int
    before_m: float
    before_deg: float
    after_m: float
    after_deg: float

    @property
    def is_wrong(self) -> bool:
        """Whether they do not fit after it."""
        return self.after_m > WRONG_M or self.after_deg > WRONG_DEG


def judge_closure(
    frame: int,
    past: tuple[NDArray[np.int32], Float64],
    truth: Float64,
    unclosed: Float64,
    closed: Float64,
    window: int,
) -> Closure:
    """Compare the poses before and after a closure with where the old map says the camera is.

    That is the true motion from the nearest old frame, applied to its estimate.
    """
    frames, poses = past
    old = frames < frame - window
    frames, poses = frames[old], poses[old]
    motions = invert(truth[frames]) @ truth[frame]
    cosines = np.clip((np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)
    nearest = int((np.linalg.norm(motions[:, :3, 3], axis=1) + np.arccos(cosines)).argmin())
    ideal = poses[nearest] @ motions[nearest]
    return Closure(frame, *_apart(ideal, unclosed), *_apart(ideal, closed))


def _apart(a: Float64, b: Float64) -> tuple[float, float]:
    distance = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return distance, float(np.degrees(relative_angle(a[:3, :3], b[:3, :3])))
