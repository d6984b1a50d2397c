"""Run a trained policy as a planner."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from ms_slam_agents.policy import Policy

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
        InputError: no policy file, an untrained one, one trained for another observation variant
            or number of actions, or a ``deterministic`` that is no truth value.
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
        path = str(path or os.environ.get(PATH_VARIABLE) or "")
        if not path:
            raise InputError(
                f"planner {_NAMES[self.observation]} needs a policy file: option path=..., "
                f"or the environment variable {PATH_VARIABLE}"
            )
        self.deterministic = _truth(deterministic)
        self.policy = Policy.load(path)
        metadata = self.policy.metadata
        if metadata.observation != self.observation:
            right = _NAMES.get(metadata.observation)
            raise InputError(
                f"{path!r} was trained on observation {metadata.observation!r}, planner "
                f"{_NAMES[self.observation]} runs policies trained on {self.observation!r}"
                + (f": use {right}" if right else "")
            )
        if not metadata.epochs:
            raise InputError(f"{path!r} is untrained: its network has had no update")
        try:
            self.policy.check_fits(env)
        except InputError as error:
            raise InputError(f"{path!r}: {error}") from None

    def act(self, observation: Any, info: dict[str, Any]) -> Any:
        """Draw an unmasked action from the policy's probabilities, or take the most probable.

        An integer, or an array of them where an action has several.
        """
        rng = None if self.deterministic else self.rng
        return self.policy.act(observation, self.env.action_masks(), rng)


class TrainedFeaturesPolicy(TrainedPolicy):
    """A policy trained by ``train_sb3`` on the observation variant ``features``."""

    observation = "features"


def _truth(value: bool | str) -> bool:
    words = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
    try:
        return words[str(value).lower()]
    except KeyError:
        raise InputError(f"deterministic = {value!r}; valid choices: true, false") from None
