"""A planner that tries motions in the simulator before it makes one: a teacher for any reward."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.greedy import distance_to_targets
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import check_range, check_whole
from ms_slam_env.env import PrivilegedPlanner
from ms_slam_env.env.env_config import RewardConfig
from ms_slam_env.errors import unknown

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import PrivilegedView


ORDERS = ("random", "greedy")
TERMS = tuple(field.name for field in fields(RewardConfig))


class Foresight(PrivilegedPlanner):
    """Tries motions in the simulator and makes the one with the largest reward.

    Looks one step ahead, for any reward. Since a robot cannot undo a motion, it is an upper bound
    rather than a competitor, and a teacher for agents (see `oracle`).

    Args:
        robot: the robot's view, including the truth.
        seed: for drawing motions.
        tried: number of possible motions that are tried.
        order: which motions: ``random`` draws them again for each decision, ``greedy`` takes those
            whose predicted divergences are nearest to the targets.
        noise: how far the term ``trajectory_error`` is shrunk towards zero. Over an episode its sum
            is the final error, so small values at one step are undone by the next ones, while large
            ones are slips.
        temperature: reward deficit at which a motion is 1/e as good a choice as the best.
        without: reward terms to ignore, joined by ``+``, to test what each contributes.

    Raises:
        InputError: an option out of its range, or an unknown order or term.
    """

    motions_only = True

    def __init__(
        self,
        robot: PrivilegedView,
        seed: int = 0,
        tried: int = 49,
        order: str = "random",
        noise: float = 0.0,
        temperature: float = 0.02,
        without: str = "",
    ) -> None:
        super().__init__(robot, seed)
        self.tried, self.order = tried, order
        self.noise, self.temperature = noise, temperature
        check_range(self, "tried", 1, 1000)
        check_whole(self, "tried")
        check_range(self, "noise", 0, 1000)
        check_range(self, "temperature", 1e-6, 1000)
        if order not in ORDERS:
            raise unknown("order of foresight", order, ORDERS)
        self.without = tuple(filter(None, str(without or "").split("+")))
        for name in self.without:
            if name not in TERMS:
                raise unknown("term of the reward", name, TERMS)
        self.weights: Float64 | None = None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Try some motions and return the best."""
        possible = self._first(np.flatnonzero(self.robot.action_masks()))
        rewards = np.array([self._worth(terms) for terms in self.robot.foresee_terms(possible)])
        self.weights = np.zeros(len(self.robot.action_masks()))
        self.weights[possible] = np.exp((rewards - rewards.max()) / self.temperature)
        return int(possible[np.argmax(rewards)])

    def _first(self, possible: NDArray[np.int64]) -> NDArray[np.int64]:
        """The possible motions to try."""
        if self.order == "greedy":
            predicted = self.robot.lookahead()[possible].T
            order = np.argsort(distance_to_targets(*predicted, self.robot.targets))
        else:
            order = self.rng.permutation(len(possible))
        return possible[order[: self.tried]]

    def _worth(self, terms: dict[str, float]) -> float:
        """Sum of the terms that count, with the noise of ``trajectory_error`` removed."""
        terms = {name: term for name, term in terms.items() if name not in self.without}
        growth = terms.get("trajectory_error", 0.0)  # a user-defined reward may have none
        return sum(terms.values()) - float(np.clip(growth, -self.noise, self.noise))

    def preferences(self) -> Float64 | None:
        """Probabilities (n,) of the motions by their rewards; 0 for those not tried."""
        return None if self.weights is None else self.weights / self.weights.sum()
