"""What an action is: a motion, or a motion and the SLAM configuration for its frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation import AdaptationConfig, AdaptiveSlam, AgentConfig
from ms_slam_env.slam.slam_backend import SlamBackend


class MaskedDiscrete(spaces.Discrete):
    """``Discrete`` that samples with masks of truth values, as ``info["action_mask"]`` is."""

    def sample(self, mask: Any = None, probability: Any = None) -> np.int64:
        """An action, among those whose mask (n,) is true if there is one."""
        return super().sample(_int8(mask), probability)


class MaskedMultiDiscrete(spaces.MultiDiscrete):
    """``MultiDiscrete`` that samples with one mask of all its parts, one after the other."""

    def sample(self, mask: Any = None, probability: Any = None) -> NDArray[np.int64]:
        """Actions, among those whose mask (n + K,), or tuple of masks, is true if there is one."""
        if isinstance(mask, np.ndarray):
            mask = tuple(np.split(mask, np.cumsum(self.nvec)[:-1]))
        return super().sample(None if mask is None else tuple(map(_int8, mask)), probability)


def _int8(mask: Any) -> Any:
    """A mask as Gymnasium takes it; of another type only one of truth values is meant."""
    is_bool = isinstance(mask, np.ndarray) and mask.dtype == bool
    return mask.astype(np.int8) if is_bool else mask


class ActionDecoder(ABC):
    """Turns an action of the agent into a motion, and whatever else it asks for.

    Attributes:
        space: of the actions.
        num_configurations: of SLAM, among which the action chooses; 1 where it does not.
    """

    space: spaces.Space[Any]
    num_configurations: int = 1

    @abstractmethod
    def decode(self, action: Any) -> int:
        """Do what the action asks for beside its motion; return the motion's index.

        Raises:
            InputError: not an action of ``space``.
        """

    @abstractmethod
    def masks(self, motion_masks: Bool) -> Bool:
        """Which actions are possible, where ``motion_masks`` (n,) says which motions are."""

    @property
    def configuration(self) -> int:
        """Index of the SLAM configuration in force."""
        return 0

    @property
    def configuration_cost(self) -> float | None:
        """Its cost; None where the agent does not choose it."""
        return None


class MotionActions(ActionDecoder):
    """``Discrete(n)``: one of n motions."""

    def __init__(self, num_motions: int) -> None:
        self.num_motions = num_motions
        self.space = MaskedDiscrete(num_motions)

    def decode(self, action: Any) -> int:
        """See the base class."""
        array = _as_array(action)
        is_integer = array.shape == () and np.issubdtype(array.dtype, np.integer)
        if not is_integer or not 0 <= int(array) < self.num_motions:
            raise InputError(f"action {action!r} is not an integer in [0, {self.num_motions - 1}]")
        return int(array)

    def masks(self, motion_masks: Bool) -> Bool:
        """The motions'."""
        return motion_masks


class MotionAndConfigurationActions(ActionDecoder):
    """``MultiDiscrete([n, K])``: one of n motions and one of K SLAM configurations.

    Args:
        num_motions: n.
        slam: takes the configuration.
        adaptation: how; says what each configuration costs.

    Raises:
        InputError: another adaptation than the agent's, or costs that are not given.
    """

    space: spaces.MultiDiscrete

    def __init__(self, num_motions: int, slam: SlamBackend, adaptation: AdaptationConfig) -> None:
        if not isinstance(adaptation, AgentConfig) or not isinstance(slam, AdaptiveSlam):
            raise InputError("adaptation must be 'agent': here the agent chooses the configuration")
        self._slam = slam
        self._costs = adaptation.costs_of(slam.intrinsics)
        self.num_configurations = len(self._costs)
        self.space = MaskedMultiDiscrete([num_motions, len(self._costs)])

    def decode(self, action: Any) -> int:
        """See the base class; the configuration is in force from the next frame on."""
        array = _as_array(action)
        if array.shape != (2,) or array not in self.space:
            sizes = " x ".join(f"[0, {n - 1}]" for n in self.space.nvec)
            raise InputError(f"action {action!r} is not two integers in {sizes}")
        self._slam.use(int(array[1]))
        return int(array[0])

    def masks(self, motion_masks: Bool) -> Bool:
        """(n + K,) the motions', then the configurations', of which each is always possible."""
        return np.concatenate([motion_masks, np.ones(len(self._costs), dtype=bool)])

    @property
    def configuration(self) -> int:
        """See the base class."""
        return self._slam.level

    @property
    def configuration_cost(self) -> float:
        """See the base class."""
        return self._costs[self.configuration]


def _as_array(action: Any) -> NDArray[Any]:
    """An action as an array; lists of unequal lengths become one that is no action."""
    try:
        return np.asarray(action)
    except (TypeError, ValueError):
        return np.empty(0)
