"""Random walk: the paper's contrast to active SLAM (section VI-B)."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box, MultiDiscrete

from ms_slam_env.env import Planner


class RandomWalk(Planner):
    """Draws one of the unblocked motions in each step, all equally likely.

    Draws the SLAM configuration in the same way, where the agent chooses it. Continuous actions are
    drawn from the whole box.
    """

    def act(self, observation: Any, info: dict[str, Any]) -> Any:
        """Draw an action uniformly from the unmasked ones, each of its parts separately."""
        space = self.robot.action_space
        if isinstance(space, Box):
            return self.rng.uniform(space.low, space.high).astype(space.dtype)
        mask = self.robot.action_masks()
        if not isinstance(space, MultiDiscrete):
            return int(self.rng.choice(np.flatnonzero(mask)))
        parts = np.split(mask, np.cumsum(space.nvec)[:-1])
        return np.array([self.rng.choice(np.flatnonzero(part)) for part in parts])
