"""Observation variant ``lookahead``: the compact vector and the predicted divergences."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.env.observations.base import Observation, RobotKnowledge
from ms_slam_env.env.observations.features import FeaturesObservation

_DIVERGENCE_CAP = 5.0  # in units of M_I, M_D


class LookaheadObservation(Observation):
    """``features`` followed by the n x 2 predicted divergences / (M_I, M_D), clipped at 5."""

    def __init__(self, intrinsics: Intrinsics, num_actions: int) -> None:
        self._features = FeaturesObservation(intrinsics, num_actions)
        size = self._features.space.shape[0] + 2 * num_actions  # type: ignore[index]
        self.space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def build(self, knowledge: RobotKnowledge) -> NDArray[np.float32]:
        """Return the vector."""
        predicted = np.minimum(knowledge.lookahead(), _DIVERGENCE_CAP)
        return np.concatenate(
            [self._features.build(knowledge), predicted.ravel().astype(np.float32)]
        )
