"""The interface of planners: they choose the next action of an environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv


class Planner(ABC):
    """Chooses actions for one environment.

    A planner may use what a robot has: the observation, ``info["action_mask"]`` and the
    environment's predictions from the map (``lookahead``, ``predict_candidates``,
    ``candidate_poses``). Ground truth in ``info`` is for evaluation.

    Args:
        env: the unwrapped environment.
        seed: of the planner's own random choices.
    """

    observation: str = "features"
    """The observation variant that ``act`` expects."""

    def __init__(self, env: ActiveSlamEnv, seed: int = 0) -> None:
        self.env = env
        self.rng = np.random.default_rng(seed)

    def reset(self) -> None:  # noqa: B027 -- most planners keep nothing between episodes
        """Prepare for a new episode; called after the environment's reset."""

    @abstractmethod
    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Return the next action, given what ``reset`` or ``step`` last returned."""
