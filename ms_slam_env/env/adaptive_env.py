"""The environment in which the agent also chooses the configuration of SLAM."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env.env.active_slam import ActiveSlamEnv
from ms_slam_env.env.reward import Outcome
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation import AdaptiveSlam, AgentConfig

LEVEL = "slam_configuration"
"""Key of the configuration in an observation of several parts."""


class AdaptiveSlamEnv(ActiveSlamEnv):
    """``ActiveSlamEnv`` with the SLAM configuration as a second part of the action.

    Run-time adaptation (Saeedi et al., ICRA 2017, section V-B) as a decision of the agent: a robust
    configuration copes with a violent motion and costs more.

    ## Action space
    ``MultiDiscrete([49, K])``: the motion, as in ``ActiveSlamEnv`` (the first number is 7 with
    embodiment ``fixed-translation``), and which of K SLAM configurations, from fast to robust, the
    frames of this motion are processed under. The mask has 49 + K entries, those of the motions
    first: the form that sb3-contrib's MaskablePPO takes; every configuration is always possible.

    ## Observation space
    That of ``ActiveSlamEnv`` with the configuration in force, one-hot (K,): at the end of the
    vector, or as ``slam_configuration`` where the observation has several parts.

    ## Reward
    One more term: ``compute``, ``reward.compute`` times the configuration's cost, which is a number
    of the configuration (``adaptation.costs``) and not a clock's: two runs agree.

    ## Info
    That of ``ActiveSlamEnv``, and ``slam_configuration``, the index in force.

    ## Arguments
    Those of ``ActiveSlamEnv``; ``adaptation`` is ``agent`` and may be given as a mapping: ``name``
    ``agent``, ``configurations``, ``costs``, ``start``.

    ## Version history
    v0: first version.

    Raises:
        InputError: an unknown option or choice, a value out of range, or another adaptation.
    """

    adaptive: AdaptiveSlam

    def __init__(
        self, embodiment: str = "arm", render_mode: str | None = None, **options: Any
    ) -> None:
        options.setdefault("adaptation", "agent")
        super().__init__(embodiment, render_mode, **options)
        if not isinstance(self.config.adaptation, AgentConfig):
            raise InputError("adaptation must be 'agent': here the agent chooses the configuration")
        count = self.config.adaptation.num_configurations
        self.costs = self.config.adaptation.costs_of(self.intrinsics)
        motions = self._embodiment_type.num_actions
        self.action_space = spaces.MultiDiscrete([motions, count])
        self.observation_space = _with_level(self.observation_space, count)

    def action_masks(self) -> NDArray[np.bool_]:
        """(n + K,) which motions, and which configurations, are possible now."""
        return np.concatenate([super().action_masks(), np.ones(len(self.costs), dtype=bool)])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make one motion and track its frames under the chosen configuration.

        Raises:
            InputError: an action that is not two integers of the action space, or no reset before.
        """
        self._current()
        array = np.asarray(action)
        if array.shape != (2,) or array not in self.action_space:
            sizes = " x ".join(f"[0, {n - 1}]" for n in self._sizes)
            raise InputError(f"action {action!r} is not two integers in {sizes}")
        self.adaptive.use(int(array[1]))
        return super().step(array[0])

    @property
    def _sizes(self) -> list[int]:
        return [self._embodiment_type.num_actions, len(self.costs)]

    def _reward_terms(self, outcome: Outcome) -> dict[str, float]:
        cost = self.costs[self.adaptive.level]
        terms = super()._reward_terms(outcome)
        return {**terms, "compute": -self.config.reward.compute * cost}

    def _build_observation(self) -> Any:
        observation = super()._build_observation()
        level = np.eye(len(self.costs), dtype=np.float32)[self.adaptive.level]
        if isinstance(observation, dict):
            return {**observation, LEVEL: level}
        return np.concatenate([observation, level])

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), LEVEL: self.adaptive.level}


def _with_level(space: spaces.Space[Any], count: int) -> spaces.Space[Any]:
    """The observation space with a one-hot vector of ``count`` more."""
    if isinstance(space, spaces.Dict):
        level = spaces.Box(0, 1, (count,), np.float32)
        return spaces.Dict({**space.spaces, LEVEL: level})
    assert isinstance(space, spaces.Box)  # observations are images and state, or a vector
    return spaces.Box(-np.inf, np.inf, (space.shape[0] + count,), np.float32)
