"""Run a trained policy as a planner."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_agents import artefact

from ms_slam_env.env.planner import Planner
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
        num_actions = int(env.action_space.n)  # type: ignore[attr-defined]
        if self.policy.num_actions != num_actions:
            raise InputError(
                f"{path!r} chooses among {self.policy.num_actions} actions, "
                f"the environment has {num_actions}"
            )

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Draw an unmasked action from the policy's probabilities, or take the most probable."""
        mask = self.env.action_masks()
        (probabilities,) = self.policy.probabilities(observation[None], mask[None])
        if self.deterministic:
            return int(np.argmax(probabilities))
        return int(self.rng.choice(len(probabilities), p=probabilities))


class TrainedFeaturesPolicy(TrainedPolicy):
    """A policy trained by ``train_sb3`` on the observation variant ``features``."""

    observation = "features"


def _truth(value: bool | str) -> bool:
    words = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
    try:
        return words[str(value).lower()]
    except KeyError:
        raise InputError(f"deterministic = {value!r}; valid choices: true, false") from None
