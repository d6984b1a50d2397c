"""Random walk: the paper's contrast to active SLAM (section VI-B)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ms_slam_env.env import Planner


class RandomWalk(Planner):
    """Each step takes one of the motions that are not blocked, all equally likely."""

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Draw an action uniformly from the unmasked ones."""
        return int(self.rng.choice(np.flatnonzero(self.env.action_masks())))
