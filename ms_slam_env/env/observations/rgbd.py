"""Observation variant ``rgbd``: the live images and the state vector."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from ms_slam_env.camera import Intrinsics
from ms_slam_env.env.observations.base import (
    NUM_STATE,
    Observation,
    RobotKnowledge,
    state_vector,
)

_MAX_DEPTH_M = 20.0


class RGBDObservation(Observation):
    """``color`` (H, W, 3) uint8, ``depth`` (H, W) float32 metres, ``state`` (28,) float32."""

    def __init__(self, intrinsics: Intrinsics, num_actions: int) -> None:
        self.space = spaces.Dict(
            {
                "color": spaces.Box(0, 255, (*intrinsics.shape, 3), np.uint8),
                "depth": spaces.Box(0, _MAX_DEPTH_M, intrinsics.shape, np.float32),
                "state": spaces.Box(-np.inf, np.inf, (NUM_STATE,), np.float32),
            }
        )

    def build(self, knowledge: RobotKnowledge) -> dict[str, Any]:
        """Return copies of the live images and the state vector."""
        return {
            "color": knowledge.frame.color.copy(),
            "depth": np.minimum(knowledge.frame.depth, _MAX_DEPTH_M),
            "state": state_vector(knowledge),
        }
