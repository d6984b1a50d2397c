"""Next best view of several robots that share one map and divide the unknown space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.nbv import NextBestView
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import check_range
from ms_slam_env.planning import OccupancyGrid

if TYPE_CHECKING:
    from ms_slam_env.camera import Intrinsics
    from ms_slam_env.env.robot_view import RobotView


_LOOK_M = 1.5  # distance in front of a goal of the point that it looks at


class SharedMap:
    """One occupancy grid for all robots, with poses in a common frame."""

    def __init__(self, cell_m: float, reach_m: float) -> None:
        self.grid = OccupancyGrid(cell_m, reach_m)

    def add(
        self, slam: Any, depth: NDArray[np.float32], pose: Float64, intrinsics: Intrinsics
    ) -> None:
        """Carve the frame (H, W) that a robot's SLAM tracked at a pose (4, 4)."""
        self.grid.integrate(depth, pose, intrinsics)


class TeamNextBestView(NextBestView):
    """Next best view in a team's map: a view gains less where a teammate's goal looks.

    The expected gain of a goal is multiplied by 1 - max(0, 1 - d / spread) for each teammate, d the
    distance between the points that the two goals look at (Burgard, Moors, Stachniss, Schneider,
    "Coordinated multi-robot exploration", T-RO 2005, section III-B). Without a call of ``join`` it
    is `NextBestView` in a map without submaps.

    Args:
        robot: the robot's view.
        seed: for drawing goals.
        spread_m: distance d from which a teammate's goal has no effect; 0: the robots share their
            map but do not divide it.
        **options: of `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    map: Any
    mates: list[TeamNextBestView]

    def __init__(
        self, robot: RobotView, seed: int = 0, spread_m: float = 3.0, **options: Any
    ) -> None:
        super().__init__(robot, seed, **options)
        self.spread_m = spread_m
        check_range(self, "spread_m", 0, 1000)

    def reset(self) -> None:
        """Forget the last episode and the team."""
        super().reset()
        self.map = SharedMap(self.cell_m, self.reach_m)
        self.mates = []

    def join(self, team: Sequence[TeamNextBestView]) -> None:
        """Share the map with ``team``, which includes this planner; call after every ``reset``."""
        self.mates = [mate for mate in team if mate is not self]
        self.map = team[0].map

    def gain_of(self, poses: Float64) -> Float64:
        """Expected gain (N,) of poses (N, 4, 4), m^3, that the teammates leave."""
        return super().gain_of(poses) * self.left_over(poses)

    def left_over(self, goals: Float64) -> Float64:
        """Share (N,) of the gain of goals (N, 4, 4) that the teammates' goals leave."""
        share = np.ones(len(goals))
        taken = [mate.goal for mate in self.mates if mate.goal is not None]
        if self.spread_m > 0:
            for goal in taken:
                apart = np.linalg.norm(looked_at(goals) - looked_at(goal[None]), axis=1)
                share *= np.minimum(1.0, apart / self.spread_m)
        return share


def looked_at(poses: Float64) -> Float64:
    """Points (N, 3) that poses (N, 4, 4) look at."""
    return poses[:, :3, 3] + _LOOK_M * poses[:, :3, 2]
