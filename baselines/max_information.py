"""Most empty pixels: look where the map is emptiest."""

from __future__ import annotations

from typing import Any

import numpy as np

from ms_slam_env.env import Planner


class MaxInformation(Planner):
    """Takes the motion whose view is predicted to show most unmapped surface.

    The classical contrast to a divergence planner: next best view by expected gain, regardless of
    whether SLAM can follow. The gain of a view is its number of pixels for which the map predicts
    no depth: they show surface not yet seen, or nothing within the sensor's range.

    This is a stand-in for the rivals that Saeedi et al. (ICRA 2017) cite, not their criterion,
    which is the mutual information of map m and measurement z, I(m; z) = H(m) - E[H(m | z)], over
    the cells of a probabilistic map: here a pixel counts the same whatever lies in it, and what a
    nearer unknown surface would hide counts too.
    """

    motions_only = True

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Choose the unmasked action with the largest gain, ties drawn at random."""
        depth = self.robot.predict_candidates().depth  # (n, h, w) metres, 0 = the map is empty
        unseen = np.count_nonzero(depth == 0, axis=(1, 2))  # (n,) pixels
        unseen[~self.robot.action_masks()] = -1
        return int(self.rng.choice(np.flatnonzero(unseen == unseen.max())))
