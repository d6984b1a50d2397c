"""Planners that go to views: what they know of space, how they draw and keep a goal."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.view_goals import distance_in_steps, draw_goals
from numpy.typing import NDArray

from ms_slam_env.config import check_range
from ms_slam_env.env import Planner
from ms_slam_env.mapping import OccupancyMap, expected_gain, reachable_positions

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv

Float64 = NDArray[np.float64]

ARRIVED = 3  # steps from a goal
KEPT_AWAY = 0.7  # steps from where tracking was lost
_RANGES = {
    **{"goals": (3, 10_000), "radius_m": (0.1, 100), "cost": (0, 100)},
    **{"replan": (1, 10_000), "cell_m": (0.02, 1)},
}


class GoalPlanner(Planner):
    """Carves the frames that were tracked, draws a goal now and then, and moves towards it.

    A goal is a pose of known free space. By default it is the one with the largest expected gain
    against its distance in steps (Bircher et al., ICRA 2016, weigh gain by exp(-lambda cost)).

    Args:
        env: the unwrapped environment.
        seed: of the goals drawn.
        goals: positions drawn for a goal.
        radius_m: how far a goal may be.
        cost: how much less a view is worth six steps farther away: exp(-cost).
        replan: steps after which a goal is drawn anew.
        cell_m: edge of a cell of the occupancy grid.

    Raises:
        InputError: an option out of its range.
    """

    recovers = True

    def __init__(
        self,
        env: ActiveSlamEnv,
        seed: int = 0,
        goals: int = 160,
        radius_m: float = 2.5,
        cost: float = 0.7,
        replan: int = 7,
        cell_m: float = 0.1,
    ) -> None:
        super().__init__(env, seed)
        self.goals, self.radius_m, self.cost = goals, radius_m, cost
        self.replan, self.cell_m = replan, cell_m
        self.check(_RANGES)
        self.steps = env.config.step_m, env.config.step_rad

    def check(self, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Refuse options outside ``ranges``."""
        for name, (low, high) in ranges.items():
            check_range(self, name, low, high)

    def reset(self) -> None:
        """Nothing is known yet."""
        self.map = OccupancyMap(self.cell_m)
        self.goal: Float64 | None = None
        self.age = 0
        self.lost_at = np.zeros((0, 4, 4))
        """Poses (N, 4, 4) at which tracking was lost."""
        self.reached = np.zeros((0, 4, 4))
        """Goals (N, 4, 4) that were reached."""

    def lost_by(self, action: int) -> None:
        """Keep away from where the last motion should have led."""
        self.lost_at = np.concatenate([self.lost_at, self.heading_to[None]])
        self.goal = None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Carve the last frame, keep or draw a goal, move towards it."""
        episode = self.env.episode
        here = episode.T_world_camera_estimate
        if info["tracking_ok"]:
            self.map.add(self.env.slam, episode.last_frame.depth, here, self.env.intrinsics)
        if self.goal is not None and self.arrived(here):
            self.reached = np.concatenate([self.reached, self.goal[None]])
            self.goal = None
        if self.goal is None or self.age >= self.replan:
            self.goal, self.age = self.choose_goal(here), 0
        self.age += 1
        action = self.motion_towards(self.goal)
        self.heading_to = self.env.candidate_poses()[action]
        if action == 0:
            self.goal = None
        return action

    def arrived(self, here: Float64) -> bool:
        """Whether the goal is some three steps away."""
        return bool(distance_in_steps(here[None], self.goal, *self.steps).sum() < ARRIVED)

    def is_new(self, goals: Float64, here: Float64) -> NDArray[np.bool_]:
        """Which goals (N, 4, 4) are neither where the camera is (4, 4) nor where it has been."""
        known = np.concatenate([here[None], self.reached])
        away = [distance_in_steps(goals, pose, *self.steps).sum(axis=1) for pose in known]
        return np.asarray(np.min(away, axis=0) >= ARRIVED)

    def choose_goal(self, here: Float64) -> Float64:
        """The pose (4, 4) whose gain is most worth its way from ``here`` (4, 4)."""
        poses, worth = self.drawn_goals(here)
        return poses[np.argmax(worth)]

    def drawn_goals(self, here: Float64) -> tuple[Float64, Float64]:
        """Poses (N, 4, 4) drawn for a goal, and their gain against their distance (N,), m^3."""
        free = reachable_positions(self.map.grid, here[:3, 3], self.radius_m)
        poses = draw_goals(self.rng, here, free, self.goals)
        return poses, self.worth_of(poses, here)

    def worth_of(self, poses: Float64, here: Float64) -> Float64:
        """Expected gain (N,) of poses (N, 4, 4) against their distance in steps, m^3."""
        gain = expected_gain(self.map.grid, poses, self.env.intrinsics)
        steps = 1 + distance_in_steps(poses, here, *self.steps).max(axis=1)
        return gain * np.exp(-self.cost * steps / 6)

    def near_loss(self, poses: Float64) -> NDArray[np.bool_]:
        """Which of poses (n, 4, 4) are where tracking was lost."""
        near = np.zeros(len(poses), dtype=bool)
        for lost in self.lost_at:
            near |= distance_in_steps(poses, lost, *self.steps).max(axis=1) <= KEPT_AWAY
        return near

    @abstractmethod
    def motion_towards(self, goal: Float64) -> int:
        """The motion to make next, on the way to a goal (4, 4)."""
