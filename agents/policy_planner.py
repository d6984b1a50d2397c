"""Run a trained policy as a planner."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import PolicyFile, read_policy

from ms_slam_env.env import Planner
from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView

PATH_VARIABLE = "MS_SLAM_POLICY"
SHIPPED = Path(__file__).parent / "policies"
"""The policies that come with the package, by the agent's name."""


class TrainedPolicy(Planner):
    """A policy trained by ``ms-slam train``, shown the observation that it was trained on.

    Args:
        robot: what it sees.
        seed: of the draws from the policy's probabilities.
        path: the policy file; default: what the environment variable ``MS_SLAM_POLICY`` names.
        deterministic: take the most probable action instead of drawing one; a truth value or the
            text ``true`` or ``false``.

    Raises:
        InputError: no policy file, an untrained one, one trained for another observation variant
            or number of actions, or a ``deterministic`` that is no truth value.
    """

    default_path: Path | None = None

    def __init__(
        self,
        robot: RobotView,
        seed: int = 0,
        path: str | None = None,
        deterministic: bool | str = False,
    ) -> None:
        super().__init__(robot, seed)
        path = self._path(path)
        self.deterministic = _truth(deterministic)
        self.policy = Policy(_loaded(path, _modified(path)))
        if not self.policy.metadata.epochs:
            raise InputError(f"{path!r} is untrained: its network has had no update")
        try:
            self.policy.check_fits(self.robot)
        except InputError as error:
            raise InputError(f"{path!r}: {error}") from None

    @classmethod
    def observation_for(cls, path: str | None = None, **options: Any) -> str:
        """What the policy was trained on."""
        path = cls._path(path)
        return _loaded(path, _modified(path)).metadata.observation

    @classmethod
    def _path(cls, path: str | None) -> str:
        found = str(path or cls.default_path or os.environ.get(PATH_VARIABLE) or "")
        if not found:
            raise InputError(
                "planner policy needs a policy file: option path=..., "
                f"or the environment variable {PATH_VARIABLE}"
            )
        return found

    def reset(self) -> None:
        """Nothing was seen yet."""
        self.policy.reset()

    def act(self, observation: Any, info: dict[str, Any]) -> Any:
        """Draw an unmasked action from the policy's probabilities, or take the most probable.

        An integer, or an array of them where an action has several.
        """
        rng = None if self.deterministic else self.rng
        return self.policy.act(observation, self.robot.action_masks(), rng)

    def see(self, observation: Any, info: dict[str, Any]) -> None:
        """See the base class."""
        self.policy.see(observation)


class ShippedAgent(TrainedPolicy):
    """A policy that comes with the package; it takes the most probable action unless told not to.

    Drawn from its probabilities, the area under the F-score of `agent-room` was 5 percentage points
    smaller.
    """

    def __init__(
        self,
        robot: RobotView,
        seed: int = 0,
        path: str | None = None,
        deterministic: bool | str = True,
    ) -> None:
        super().__init__(robot, seed, path, deterministic)


class RoomAgent(ShippedAgent):
    """The policy for the task ``room``, which maps; it goes back when lost."""

    recovers = True
    default_path = SHIPPED / "room.safetensors"


class PpoAgent(ShippedAgent):
    """A policy that PPO made from nothing, in rooms and with the arm; it goes back when lost."""

    recovers = True
    default_path = SHIPPED / "ppo.safetensors"


class PaperAgent(ShippedAgent):
    """The policy for ``reward="paper"``: as Algorithm 1, it keeps divergences near their targets.

    Of each motion it sees what the greedy planner does and what else planners look at, and has
    learned from motions that were tried what the divergence then is.
    """

    default_path = SHIPPED / "paper.safetensors"


@lru_cache(maxsize=8)
def _loaded(path: str, modified: float) -> PolicyFile:
    """A policy file is read once for its observation, and not again for its network."""
    return read_policy(path)


def _modified(path: str) -> float:
    return os.stat(path).st_mtime if os.path.isfile(path) else 0.0


def _truth(value: bool | str) -> bool:
    words = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
    try:
        return words[str(value).lower()]
    except KeyError:
        raise InputError(f"deterministic = {value!r}; valid choices: true, false") from None
