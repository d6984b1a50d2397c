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
"""Folder of the policies shipped with the package, named after the agents."""


class TrainedPolicy(Planner):
    """Acts by a policy trained with ``ms-slam train``, on the observation of its training.

    Args:
        robot: the robot's view.
        seed: for sampling from the policy's probabilities.
        path: the policy file; default: the environment variable ``MS_SLAM_POLICY``.
        deterministic: take the most probable action instead of sampling; a boolean or the text
            ``true`` or ``false``.

    Raises:
        InputError: no policy file, an untrained one, one trained for another observation variant
            or number of actions, or an invalid ``deterministic``.
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
        """The observation variant that the policy was trained on."""
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
        """Clear the policy's memory."""
        self.policy.reset()

    def act(self, observation: Any, info: dict[str, Any]) -> Any:
        """Sample an unmasked action from the policy's probabilities, or take the most probable.

        Returns an integer, or an array of integers where an action has several parts.
        """
        rng = None if self.deterministic else self.rng
        return self.policy.act(observation, self.robot.action_masks(), rng)

    def see(self, observation: Any, info: dict[str, Any]) -> None:
        """See the base class."""
        self.policy.see(observation)


class ShippedAgent(TrainedPolicy):
    """A policy shipped with the package; by default it takes the most probable action.

    With sampling, the area under the F-score curve of `agent-room` was 5 percentage points smaller.
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
    """The mapping policy for the task ``room``; undoes its last motions when lost."""

    recovers = True
    default_path = SHIPPED / "room.safetensors"


class PpoAgent(ShippedAgent):
    """A policy trained by PPO from scratch, in rooms and with the arm; backtracks when lost."""

    recovers = True
    default_path = SHIPPED / "ppo.safetensors"


class Sb3Agent(ShippedAgent):
    """The policy for ``reward="divergence-and-error"``, trained by Stable-Baselines3's DQN.

    It sees ``features``, without the predictions of the greedy planner, and does not backtrack when
    lost.
    """

    default_path = SHIPPED / "sb3.safetensors"


class PaperAgent(ShippedAgent):
    """The policy for ``reward="paper"``: like Algorithm 1, it keeps divergences near their targets.

    For each motion it sees the predictions of the greedy planner and the other values that planners
    use. It learned from tried motions which divergence results.
    """

    default_path = SHIPPED / "paper.safetensors"


@lru_cache(maxsize=8)
def _loaded(path: str, modified: float) -> PolicyFile:
    """Read a policy file once, for both its observation and its network."""
    return read_policy(path)


def _modified(path: str) -> float:
    return os.stat(path).st_mtime if os.path.isfile(path) else 0.0


def _truth(value: bool | str) -> bool:
    words = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
    try:
        return words[str(value).lower()]
    except KeyError:
        raise InputError(f"deterministic = {value!r}; valid choices: true, false") from None
