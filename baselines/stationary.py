"""Standing still: the smallest trajectory error of all planners, and no map."""

from __future__ import annotations

from typing import Any

from ms_slam_env.env import Planner


class Stationary(Planner):
    """Never moves.

    Include it in every comparison: its trajectory error is the lowest of all, so a measure that
    ranks it first does not measure active SLAM.
    """

    motions_only = True

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Return action 0, neither translation nor rotation."""
        return 0
