"""Discrete actions: a motion, or a motion and the SLAM configuration for its frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation import AdaptationConfig, AdaptiveSlam, AgentConfig
from ms_slam_env.slam.slam_backend import SlamBackend


class MaskedDiscrete(spaces.Discrete):
    """``Discrete`` that samples with boolean masks such as ``info["action_mask"]``."""

    def sample(self, mask: Any = None, probability: Any = None) -> np.int64:
        """Sample an action; with a mask (n,), only where it is true."""
        return super().sample(_int8(mask), probability)


class MaskedMultiDiscrete(spaces.MultiDiscrete):
    """``MultiDiscrete`` that samples with one mask, the concatenation of its parts' masks."""

    def sample(self, mask: Any = None, probability: Any = None) -> NDArray[np.int64]:
        """Sample an action; with a mask (n + K,) or a tuple of masks, only where it is true."""
        if isinstance(mask, np.ndarray):
            mask = tuple(np.split(mask, np.cumsum(self.nvec)[:-1]))
        return super().sample(None if mask is None else tuple(map(_int8, mask)), probability)


def _int8(mask: Any) -> Any:
    """Convert a boolean mask to Gymnasium's int8; masks of other types pass unchanged."""
    is_bool = isinstance(mask, np.ndarray) and mask.dtype == bool
    return mask.astype(np.int8) if is_bool else mask


class ActionDecoder(ABC):
    """Decodes the agent's action into a motion and, where it has one, a SLAM configuration.

    Attributes:
        space: the action space.
        num_configurations: number of SLAM configurations to choose from; 1 where there is no
            choice.
    """

    space: spaces.Space[Any]
    num_configurations: int = 1

    @abstractmethod
    def decode(self, action: Any) -> int | Float64:
        """Apply the action's SLAM configuration, if any; return its motion.

        An index, or where actions are continuous a twist (6,) in units of a step.

        Raises:
            InputError: not an action of ``space``.
        """

    @abstractmethod
    def masks(self, motion_masks: Bool) -> Bool:
        """Which actions are possible, given which motions are (``motion_masks``, (n,)).

        Raises:
            InputError: the actions have no mask.
        """

    @property
    def configuration(self) -> int:
        """Index of the SLAM configuration in force."""
        return 0

    @property
    def configuration_cost(self) -> float | None:
        """Cost of the SLAM configuration; None where the agent does not choose it."""
        return None


class MotionActions(ActionDecoder):
    """``Discrete(n)``: one of n motions."""

    def __init__(self, num_motions: int) -> None:
        self.num_motions = num_motions
        self.space = MaskedDiscrete(num_motions)

    def decode(self, action: Any) -> int:
        """See the base class."""
        array = as_array(action)
        is_integer = array.shape == () and np.issubdtype(array.dtype, np.integer)
        if not is_integer or not 0 <= int(array) < self.num_motions:
            raise InputError(f"action {action!r} is not an integer in [0, {self.num_motions - 1}]")
        return int(array)

    def masks(self, motion_masks: Bool) -> Bool:
        """The motion masks unchanged."""
        return motion_masks


class MotionAndConfigurationActions(ActionDecoder):
    """``MultiDiscrete([n, K])``: one of n motions and one of K SLAM configurations.

    Args:
        num_motions: n.
        slam: the backend to configure.
        adaptation: the configurations and their costs.

    Raises:
        InputError: an adaptation other than the agent's, or missing costs.
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
        array = as_array(action)
        if array.shape != (2,) or array not in self.space:
            sizes = " x ".join(f"[0, {n - 1}]" for n in self.space.nvec)
            raise InputError(f"action {action!r} is not two integers in {sizes}")
        self._slam.use(int(array[1]))
        return int(array[0])

    def masks(self, motion_masks: Bool) -> Bool:
        """(n + K,) motion masks, then configuration masks, which are always true."""
        return np.concatenate([motion_masks, np.ones(len(self._costs), dtype=bool)])

    @property
    def configuration(self) -> int:
        """See the base class."""
        return self._slam.level

    @property
    def configuration_cost(self) -> float:
        """See the base class."""
        return self._costs[self.configuration]


def as_array(action: Any) -> NDArray[Any]:
    """Convert an action to an array; ragged lists become one that is no valid action."""
    try:
        return np.asarray(action)
    except (TypeError, ValueError):
        return np.empty(0)
