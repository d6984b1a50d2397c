"""Run a trained policy as a planner."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_agents import artefact
from ms_slam_agents.evaluation import most_probable, sample

from ms_slam_env.env import Planner
from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv

PATH_VARIABLE = "MS_SLAM_POLICY"

_NAMES = {"lookahead": "policy", "features": "policy-features"}  # planners by observation


class TrainedPolicy(Planner):
    """A policy trained by ``train_sb3`` on the observation variant ``lookahead``.

    Args:
        env: the unwrapped environment.
        seed: of the draws from the policy's probabilities.
        path: the policy file; default: what the environment variable ``MS_SLAM_POLICY`` names.
        deterministic: take the most probable action instead of drawing one; a truth value or the
            text ``true`` or ``false``.

    Raises:
        InputError: no policy file, one trained for another observation variant or number of
            actions, or a ``deterministic`` that is no truth value.
    """

    observation = "lookahead"

    def __init__(
        self,
        env: ActiveSlamEnv,
        seed: int = 0,
        path: str | None = None,
        deterministic: bool | str = False,
    ) -> None:
        super().__init__(env, seed)
        path = path or os.environ.get(PATH_VARIABLE)
        if not path:
            raise InputError(
                f"planner {_NAMES[self.observation]} needs a policy file: option path=..., "
                f"or the environment variable {PATH_VARIABLE}"
            )
        self.deterministic = _truth(deterministic)
        trained_on = artefact.load_metadata(path).observation
        if trained_on != self.observation:
            right = f": use {_NAMES[trained_on]}" if trained_on in _NAMES else ""
            raise InputError(
                f"{path!r} was trained on observation {trained_on!r}, planner "
                f"{_NAMES[self.observation]} runs policies trained on {self.observation!r}{right}"
            )
        self.policy = artefact.Policy.load(path)
        parts = artefact.action_parts(env.action_space)
        if self.policy.parts != parts:
            raise InputError(
                f"{path!r} chooses among {_product(self.policy.parts)} actions, "
                f"the environment has {_product(parts)}"
            )

    def act(self, observation: Any, info: dict[str, Any]) -> Any:
        """Draw an unmasked action from the policy's probabilities, or take the most probable.

        An integer, or an array of them where an action has several.
        """
        mask = self.env.action_masks()
        probabilities = self.policy.probabilities(observation[None], mask[None])
        if self.deterministic:
            (action,) = most_probable(probabilities, self.policy.parts)
        else:
            (action,) = sample(probabilities, self.rng, self.policy.parts)
        return action if np.ndim(action) else int(action)


class TrainedFeaturesPolicy(TrainedPolicy):
    """A policy trained by ``train_sb3`` on the observation variant ``features``."""

    observation = "features"


def _product(parts: tuple[int, ...]) -> str:
    return " x ".join(map(str, parts))


def _truth(value: bool | str) -> bool:
    words = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
    try:
        return words[str(value).lower()]
    except KeyError:
        raise InputError(f"deterministic = {value!r}; valid choices: true, false") from None
