"""A planner that tries every motion before it makes one: a teacher for any reward."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.config import check_range
from ms_slam_env.env import Planner

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv

Float64 = NDArray[np.float64]


class Foresight(Planner):
    """Makes the motion with the largest reward, having tried them all in the simulator.

    One step ahead, whatever the reward is. No rival, since a robot cannot take a motion back: it
    says what there is to gain, and an agent can learn from it (see `oracle`).

    Args:
        env: the unwrapped environment.
        seed: of the motions drawn.
        tried: how many of the possible motions are tried, drawn anew for each decision.
        temperature: reward that a motion may lack to be 1/e as good a choice as the best.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self, env: ActiveSlamEnv, seed: int = 0, tried: int = 49, temperature: float = 0.02
    ) -> None:
        super().__init__(env, seed)
        self.tried, self.temperature = tried, temperature
        check_range(self, "tried", 1, 1000)
        check_range(self, "temperature", 1e-6, 1000)
        self.weights: Float64 | None = None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Try some motions, take the best of them."""
        possible = self.rng.permutation(np.flatnonzero(self.env.action_masks()))[: self.tried]
        rewards = self.env.foresee(possible)
        self.weights = np.zeros(len(self.env.action_masks()))
        self.weights[possible] = np.exp((rewards - rewards.max()) / self.temperature)
        return int(possible[np.argmax(rewards)])

    def preferences(self) -> Float64 | None:
        """Probabilities (n,) of the motions, by their rewards; none of those not tried."""
        return None if self.weights is None else self.weights / self.weights.sum()
