"""Train a policy within a planner, which leaves no choice where it decides itself."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.env.planners import Planner, Recovering, make_planner, planner_observation
from ms_slam_env.errors import InputError

_STREAM = 3  # of an episode's seed, for the planner; the environment draws from the seed itself


class ThroughPlanner(gym.Wrapper[Any, Any, Any, Any]):
    """Restricts a learner to the actions that a planner offers its policy.

    Where the planner decides itself, such as `agent-home` on the way to a goal, its action is the
    only one permitted. It has probability one for any policy, so nothing is learned from it, while
    the values of earlier choices include its outcome and duration.

    Args:
        env: to act in.
        text: the planner, ``NAME,option=value,...``.

    Raises:
        InputError: an unknown planner, one with no policy within, or one whose policy sees another
            observation.
    """

    def __init__(self, env: gym.Env[Any, Any], text: str) -> None:
        super().__init__(env)
        wanted, shown = planner_observation(text), env.unwrapped.config.observation  # type: ignore
        if wanted != shown:
            raise InputError(f"the policy within {text!r} sees {wanted!r}, not {shown!r}")
        self._text = text
        self._rng = np.random.default_rng()
        self._planner = self._make()

    def _make(self) -> Planner:
        planner = make_planner(self._text, self.unwrapped, seed=int(self._rng.integers(2**31)))
        chooses = planner.planner if isinstance(planner, Recovering) else planner
        if type(chooses).choices is Planner.choices:
            raise InputError(f"planner {self._text!r} has no policy within, as agent-home has")
        return planner

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode of the planner, too; its draws are the seed's."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng([seed, _STREAM])
        self._planner = self._make()
        self._planner.reset()
        return observation, self._ask(observation, info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take the action, and ask the planner what may be done next."""
        if action != self._wanted:
            self._planner.instead(int(action))
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not (terminated or truncated):
            info = self._ask(observation, info)
        return observation, reward, terminated, truncated, info

    def action_masks(self) -> NDArray[np.bool_]:
        """Actions (n,) that are possible and that the planner leaves open."""
        return self._masks

    def _ask(self, observation: Any, info: dict[str, Any]) -> dict[str, Any]:
        self._wanted = self._planner.act(observation, self._planner.known(info))
        choices = self._planner.choices()
        if choices is None:
            choices = np.arange(len(info["action_mask"])) == self._wanted
        self._masks = np.array(choices, dtype=bool)
        return info | {"action_mask": self._masks}
