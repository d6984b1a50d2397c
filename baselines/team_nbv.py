"""Next best view of several robots that share what they know and divide the unknown."""

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


_LOOK_M = 1.5  # in front of a goal: what it is there to see


class SharedMap:
    """One occupancy grid of all robots, whose poses are in one frame."""

    def __init__(self, cell_m: float, reach_m: float) -> None:
        self.grid = OccupancyGrid(cell_m, reach_m)

    def add(
        self, slam: Any, depth: NDArray[np.float32], pose: Float64, intrinsics: Intrinsics
    ) -> None:
        """Carve the frame (H, W) that a robot's SLAM tracked at a pose (4, 4)."""
        self.grid.integrate(depth, pose, intrinsics)


class TeamNextBestView(NextBestView):
    """Next best view in the map of a team: a view gains less where a team mate is to look.

    The expected gain of a goal is taken times 1 - max(0, 1 - d / spread) for the distance d of what
    it looks at to what each team mate's goal looks at (Burgard, Moors, Stachniss, Schneider,
    "Coordinated multi-robot exploration", T-RO 2005, section III-B). Not told of a team by
    ``join`` it is `NextBestView` in a map without submaps.

    Args:
        robot: what it sees.
        seed: of the goals drawn.
        spread_m: d at which a team mate's goal takes nothing away; 0: the robots share their map
            but do not divide it.
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
        """Nothing is known yet, nobody is there."""
        super().reset()
        self.map = SharedMap(self.cell_m, self.reach_m)
        self.mates = []

    def join(self, team: Sequence[TeamNextBestView]) -> None:
        """Share the map with ``team``, itself among it; called after every ``reset``."""
        self.mates = [mate for mate in team if mate is not self]
        self.map = team[0].map

    def gain_of(self, poses: Float64) -> Float64:
        """Expected gain (N,) of poses (N, 4, 4), m^3, that the team mates leave."""
        return super().gain_of(poses) * self.left_over(poses)

    def left_over(self, goals: Float64) -> Float64:
        """Share (N,) of the gain of goals (N, 4, 4) that the team mates' goals leave."""
        share = np.ones(len(goals))
        taken = [mate.goal for mate in self.mates if mate.goal is not None]
        if self.spread_m > 0:
            for goal in taken:
                apart = np.linalg.norm(looked_at(goals) - looked_at(goal[None]), axis=1)
                share *= np.minimum(1.0, apart / self.spread_m)
        return share


def looked_at(poses: Float64) -> Float64:
    """Points (N, 3) in front of poses (N, 4, 4)."""
    return poses[:, :3, 3] + _LOOK_M * poses[:, :3, 2]
