"""Where the camera is on a frame that SLAM does not process."""

from __future__ import annotations

from typing import Any

import numpy as np

from ms_slam_env.geometry import invert, se3_exp, se3_log
from ms_slam_env.slam.base import Float64


class Prediction:
    """Carries the last processed pose on.

    Args:
        is_moving: on with the velocity between the last two processed frames, but no further than
            the camera moved between them; else at rest. A frame dropped for its likeness cannot be
            far away: without the limit a camera that stops is carried on.
    """

    def __init__(self, is_moving: bool) -> None:
        self._is_moving = is_moving
        self.reset()

    def reset(self) -> None:
        """Forget every pose."""
        self._pose: Float64 = np.eye(4)
        self._twist: Float64 = np.zeros(6)  # of the last motion, which took so many frames:
        self._frames = 1

    def observe(self, T_world_camera: Float64, frames: int, continues: bool) -> None:
        """Note the pose of a processed frame, ``frames`` after the one before.

        ``continues`` tells whether the motion between them was the camera's: not at the start, and
        not across lost tracking or a closed loop.
        """
        if self._is_moving and continues:
            self._twist = se3_log(invert(self._pose) @ T_world_camera)
        else:
            self._twist = np.zeros(6)
        self._pose = T_world_camera.copy()
        self._frames = frames

    def pose(self, frames: int) -> Float64:
        """T_world_camera (4, 4) ``frames`` after the last processed frame."""
        if not self._is_moving:
            return self._pose.copy()
        return self._pose @ se3_exp(min(1.0, frames / self._frames) * self._twist)

    def guess(self, frames: int) -> Float64 | None:
        """The same as a guess for tracking; None where no motion is known."""
        return self.pose(frames) if self._twist.any() else None

    def get_state(self) -> dict[str, Any]:
        """Pose and last motion."""
        return {"pose": self._pose.copy(), "twist": self._twist.copy(), "frames": self._frames}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        self._pose, self._twist = state["pose"].copy(), state["twist"].copy()
        self._frames = state["frames"]
