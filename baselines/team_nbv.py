"""Next best view of several robots that share what they know and divide the frontiers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.view_goals import draw_goals, frontiers, views_of
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ms_slam_env.config import check_range
from ms_slam_env.geometry import look_at
from ms_slam_env.mapping import OccupancyGrid, expected_gain, reachable_positions

if TYPE_CHECKING:
    from ms_slam_env.camera import Intrinsics
    from ms_slam_env.env.active_slam import ActiveSlamEnv

Float64 = NDArray[np.float64]

_LOOK_M = 1.5  # in front of a goal: what it is there to see
_AHEAD_M = 0.6  # on the way to a goal that lies farther
_FRONTIERS = 24  # largest ones that a view is sought of


class SharedMap:
    """One occupancy grid of all robots, whose poses are in one frame."""

    def __init__(self, cell_m: float) -> None:
        self.grid = OccupancyGrid(cell_m)

    def add(
        self, slam: Any, depth: NDArray[np.float32], pose: Float64, intrinsics: Intrinsics
    ) -> None:
        """Carve the frame (H, W) that a robot's SLAM tracked at a pose (4, 4)."""
        self.grid.integrate(depth, pose, intrinsics)


class TeamNextBestView(NextBestView):
    """Next best view in the map of a team: a view is worth less where a team mate is to look.

    Goals are drawn in reach and set before frontiers (Yamauchi, CIRA 1997). Their worth is the
    expected gain against the way to them through known free space, times 1 - max(0, 1 - d / spread)
    for the distance d to where each team mate's goal looks (Burgard, Moors, Stachniss, Schneider,
    "Coordinated multi-robot exploration", T-RO 2005, section III-B). Alone, or not yet told of a
    team by ``join``, it divides nothing.

    Args:
        env: the unwrapped environment.
        seed: of the goals drawn.
        spread_m: d at which a team mate's goal takes nothing away; 0: the robots share their map
            but do not divide the frontiers.
        **options: of the goals, see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    map: Any
    mates: list[TeamNextBestView]

    def __init__(
        self, env: ActiveSlamEnv, seed: int = 0, spread_m: float = 3.0, **options: Any
    ) -> None:
        super().__init__(env, seed, **{"radius_m": 6.0, "cost": 0.2, "replan": 10, **options})
        self.spread_m = spread_m
        check_range(self, "spread_m", 0, 1000)

    def join(self, team: Sequence[TeamNextBestView]) -> None:
        """Share the map with ``team``, itself among it; called after every ``reset``."""
        self.mates = [mate for mate in team if mate is not self]
        self.map = team[0].map

    def reset(self) -> None:
        """Nothing is known yet, nobody is there."""
        super().reset()
        self.map = SharedMap(self.cell_m)
        self.mates = []
        self.way = np.zeros((0, 3))
        """Positions (N, 3) on the way to the goal."""

    def drawn_goals(self, here: Float64) -> tuple[Float64, Float64]:
        """Poses (N, 4, 4) for a goal, and what they are worth to this robot (N,), m^3."""
        free = reachable_positions(self.map.grid, here[:3, 3], self.radius_m)
        drawn = draw_goals(self.rng, here, free, self.goals)
        if len(free):
            edges = frontiers(self.map.grid, here[:3, 3], self.radius_m)[:_FRONTIERS]
            drawn = np.concatenate([drawn, views_of(edges, free, here[:3, 3], _LOOK_M)])
        self._ways = Ways(free, here[:3, 3], self.cell_m)
        gain = expected_gain(self.map.grid, drawn, self.env.intrinsics)
        steps = 1 + self._ways.lengths(drawn[:, :3, 3]) / self.steps[0]
        return drawn, gain * np.exp(-self.cost * steps / 6) * self.left_over(drawn)

    def left_over(self, goals: Float64) -> Float64:
        """Share (N,) of the worth of goals (N, 4, 4) that the team mates' goals leave."""
        share = np.ones(len(goals))
        taken = [mate.goal for mate in self.mates if mate.goal is not None]
        if self.spread_m > 0:
            for goal in taken:
                apart = np.linalg.norm(looked_at(goals) - looked_at(goal[None]), axis=1)
                share *= np.minimum(1.0, apart / self.spread_m)
        return share

    def choose_goal(self, here: Float64) -> Float64:
        """The pose (4, 4) most worth its way, which is kept."""
        goal = super().choose_goal(here)
        self.way = self._ways.to(goal[:3, 3])
        return goal

    def motion_towards(self, goal: Float64) -> int:
        """The admissible motion that comes nearest to the goal, or to the next bend before it."""
        position = self.env.episode.T_world_camera_estimate[:3, 3]
        if not len(self.way) or np.linalg.norm(goal[:3, 3] - position) < _AHEAD_M:
            return super().motion_towards(goal)
        nearest = int(np.argmin(np.linalg.norm(self.way - position, axis=1)))
        ahead = min(len(self.way) - 1, nearest + max(1, round(_AHEAD_M / self.cell_m)))
        gaze = self.way[min(len(self.way) - 1, ahead + (ahead - nearest))] - position
        gaze[2] *= 0.3
        if np.linalg.norm(gaze[:2]) < self.cell_m:
            return super().motion_towards(goal)
        target = look_at(position, position + gaze)
        target[:3, 3] = self.way[ahead]
        return super().motion_towards(target)


class Ways:
    """Shortest ways through free cells from where a robot is.

    Args:
        free: (M, 3) centres of cells.
        here: (3,) position.
        cell_m: edge of a cell.
    """

    def __init__(self, free: Float64, here: Float64, cell_m: float) -> None:
        self._free, self._here = free, here
        if not len(free):
            return
        cells = np.round((free - free.min(axis=0)) / cell_m).astype(np.int64)
        shape = cells.max(axis=0) + 2
        number = np.full(shape, -1)
        number[tuple(cells.T)] = np.arange(len(cells))
        pairs = []
        for axis in np.eye(3, dtype=np.int64):
            neighbour = number[tuple((cells + axis).T)]
            has = neighbour >= 0
            pairs.append(np.stack([np.flatnonzero(has), neighbour[has]]))
        a, b = np.concatenate(pairs, axis=1)
        graph = coo_array((np.full(len(a), cell_m), (a, b)), shape=(len(free),) * 2).tocsr()
        start = int(np.argmin(((free - here) ** 2).sum(axis=1)))
        self._far, self._before = dijkstra(
            graph, directed=False, indices=start, return_predecessors=True
        )

    def lengths(self, positions: Float64) -> Float64:
        """Lengths (N,) in metres of the ways to positions (N, 3) that are cells, or here."""
        straight = np.linalg.norm(positions - self._here, axis=1)
        if not len(self._free):
            return straight
        nearest = [int(np.argmin(((self._free - p) ** 2).sum(axis=1))) for p in positions]
        return np.where(straight < 1e-6, 0.0, np.maximum(straight, self._far[nearest]))

    def to(self, position: Float64) -> Float64:
        """Cells (K, 3) of the way to a position (3,), from here on."""
        if not len(self._free):
            return np.zeros((0, 3))
        at = int(np.argmin(((self._free - position) ** 2).sum(axis=1)))
        way = []
        while at >= 0:
            way.append(self._free[at])
            at = int(self._before[at])
        return np.array(way[::-1])


def looked_at(poses: Float64) -> Float64:
    """Points (N, 3) in front of poses (N, 4, 4)."""
    return poses[:, :3, 3] + _LOOK_M * poses[:, :3, 2]
