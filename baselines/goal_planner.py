"""Base of the planners that go to views: occupancy, and how goals are drawn and kept."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.view_goals import views_anywhere
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import check_range, check_whole
from ms_slam_env.env import Planner
from ms_slam_env.geometry import look_at, make_pose
from ms_slam_env.planning import FREE, OccupancyMap, expected_gain, shortest_ways
from ms_slam_env.planning.view_goals import distance_in_steps

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


ARRIVED = 3  # steps from a goal at which it counts as reached
KEPT_AWAY = 0.7  # steps to keep from poses where tracking was lost
_LEAST = 1e-6  # least metres or radians of a step, to avoid division by zero
_SAME = 0.5  # steps within which a pose counts as visited
_LOOKAHEAD = 6  # positions of a way that are looked ahead
_RANGES = {
    **{"goals": (3, 10_000), "radius_m": (0.1, 100), "cost": (0, 100)},
    **{"replan": (1, 10_000), "cell_m": (0.02, 1), "reach_m": (0.5, 100)},
    **{"enough_m3": (0, 1000), "far_m": (0.1, 1000)},
}


class GoalPlanner(Planner):
    """Carves tracked frames into an occupancy grid, draws goals, and moves towards them.

    A goal is a pose in known free space. By default it is the one with the best expected gain for
    its distance in steps (Bircher et al., ICRA 2016, weigh gain by exp(-lambda cost)). If that
    gains too little, the goal is the one anywhere in known free space with the most gain per step
    of its path (as Dang et al., J. Field Robotics 2020, do globally).

    Args:
        robot: the robot's view.
        seed: for drawing goals.
        goals: number of positions drawn to choose a goal from.
        radius_m: largest distance of a goal.
        cost: a view six steps farther away is worth exp(-cost) times as much.
        replan: steps after which a new goal is drawn.
        cell_m: edge of a cell of the occupancy grid.
        reach_m: depth up to which a frame marks cells as free or occupied.
        enough_m3: unknown volume that a nearby goal should show.
        far_m: largest distance of a goal if no nearby one shows enough.

    Raises:
        InputError: an option out of its range.
    """

    recovers = True
    motions_only = True

    def __init__(
        self,
        robot: RobotView,
        seed: int = 0,
        goals: int = 160,
        radius_m: float = 2.5,
        cost: float = 0.7,
        replan: int = 7,
        cell_m: float = 0.1,
        reach_m: float = 3.5,
        enough_m3: float = 1.0,
        far_m: float = 12.0,
    ) -> None:
        super().__init__(robot, seed)
        self.goals, self.radius_m, self.cost = goals, radius_m, cost
        self.replan, self.cell_m, self.reach_m = replan, cell_m, reach_m
        self.enough_m3, self.far_m = enough_m3, far_m
        self.check(_RANGES, "goals", "replan")
        self.steps = max(self.robot.step_m, _LEAST), max(self.robot.step_rad, _LEAST)
        self.reset()

    def check(self, ranges: Mapping[str, tuple[float, float]], *counted: str) -> None:
        """Refuse options outside ``ranges``, and fractional values of those in ``counted``."""
        for name, (low, high) in ranges.items():
            check_range(self, name, low, high)
        for name in counted:
            check_whole(self, name)

    def reset(self) -> None:
        """Forget the last episode."""
        self.map = OccupancyMap(self.cell_m, self.reach_m)
        self.goal: Float64 | None = None
        self.age = 0
        self.way = np.zeros((0, 3))
        """Positions (K, 3) of the path to the goal."""
        self.lost_at = np.zeros((0, 4, 4))
        """Poses (N, 4, 4) at which tracking was lost."""
        self.done_with = np.zeros((0, 4, 4))
        """Goals (N, 4, 4) that were reached or given up."""
        self.given_up = 0
        """Number of goals since the last one reached."""
        self.begun = 0.0
        """Motions to the goal when it was chosen or last checked."""
        self.passed: list[Float64] = []
        """Poses (4, 4) at which motions were chosen for their nearby gain."""
        self.leaves = False
        """Whether it goes to a goal because such motions led back to a visited pose."""

    def instead(self, action: int) -> None:
        """Record where the motion that was made leads."""
        self.heading_to = self.robot.candidate_poses()[action]

    def lost_by(self, action: int) -> None:
        """Keep away from the end of the last motion."""
        self.lost_at = np.concatenate([self.lost_at, self.heading_to[None]])
        self.goal, self.passed = None, []

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Carve the last frame and choose a motion."""
        here = self.robot.T_world_camera_estimate
        if info["tracking_ok"]:
            self.map.add(self.robot, self.robot.last_frame.depth, here, self.robot.intrinsics)
        action = self.choose_motion(here)
        self.heading_to = self.robot.candidate_poses()[action]
        if np.allclose(self.heading_to, here):  # it stays
            self.goal = None
        return action

    def choose_motion(self, here: Float64) -> int:
        """The next motion from a pose (4, 4), towards the present goal or a new one."""
        if self.goal is not None:
            self.judge_goal(here)
        return self.go_to_goal(here)

    def go_to_goal(self, here: Float64) -> int:
        """The motion towards the goal; draws a goal if there is none."""
        if self.goal is None:
            self.find_goal(here)
        self.age += 1
        return self.motion_towards(self.next_on_way(here))

    def must_leave(self, here: Float64) -> bool:
        """Whether to go to a goal regardless of nearby gain.

        The best nearby view may be out of reach for SLAM or the camera, and the next best ones may
        lead back and forth for ever. Once the camera revisits a pose, it goes to a goal first.
        """
        if self.leaves and self.goal is not None:
            self.judge_goal(here)
        self.leaves = self.leaves and self.goal is not None
        if self.goal is None:
            passed = np.reshape(self.passed, (-1, 4, 4))
            away = distance_in_steps(passed, here, *self.steps).max(axis=1)
            self.leaves = bool((away < _SAME).any())
            self.passed = [] if self.leaves else [*self.passed, here.copy()]
        return self.leaves

    def find_goal(self, here: Float64) -> None:
        """Choose a nearby goal, or a far one if that gains too little, and the path to it."""
        self.ways = shortest_ways(self.map.grid, here[:3, 3], self.radius_m)
        goal = self.choose_goal(here)
        if self.gain_of(goal[None])[0] < self.enough_m3:
            self.ways = shortest_ways(self.map.grid, here[:3, 3], self.far_m)
            goal = self.far_goal(here, goal)
        self.goal, self.age = goal, 0
        self.way = self.ways.to(_nearest(self.ways.positions, goal[:3, 3]))
        self.begun = self.steps_to_goal(here)

    def judge_goal(self, here: Float64) -> None:
        """Drop the goal if it is reached, comes no nearer, or is old and not far."""
        assert self.goal is not None
        left = self.steps_to_goal(here)
        is_far = self.metres_left(here) > self.radius_m
        is_old, is_reached = self.age >= self.replan, left < ARRIVED
        if is_reached or (is_old and left >= self.begun):
            self.given_up = 0 if is_reached else self.given_up + 1
            self.done_with = np.concatenate([self.done_with, self.goal[None]])
            self.goal = None
        elif is_old:
            is_worth_it = self.gain_of(self.goal[None])[0] >= self.enough_m3
            self.goal = self.goal if is_far and is_worth_it else None
            self.begun, self.age = left, 0

    def steps_to_goal(self, here: Float64) -> float:
        """Number of motions from a pose (4, 4) to the goal along its path."""
        assert self.goal is not None
        straight, turns = distance_in_steps(here[None], self.goal, *self.steps)[0]
        return float(max(straight, self.metres_left(here) / self.steps[0]) + turns)

    def metres_left(self, here: Float64) -> float:
        """Remaining length of the path from a pose (4, 4)."""
        ahead = self.way[_nearest(self.way, here[:3, 3]) :]
        return float(np.linalg.norm(np.diff(ahead, axis=0), axis=1).sum())

    def next_on_way(self, here: Float64) -> Float64:
        """The goal, or the farthest pose (4, 4) on the path that can be reached straight."""
        assert self.goal is not None
        ahead = self.way[_nearest(self.way, here[:3, 3]) :]
        shares = np.linspace(0, 1, 2 * _LOOKAHEAD)[:, None, None]
        between = here[:3, 3] + shares * (ahead[: _LOOKAHEAD + 1] - here[:3, 3])
        is_free = self.map.grid.states_of(between.reshape(-1, 3)) == FREE
        straight = np.flatnonzero(is_free.reshape(len(shares), -1)[1:].all(axis=0))
        index = int(straight[-1]) if len(straight) else min(1, len(ahead) - 1)
        if index == len(ahead) - 1:
            return self.goal
        beyond = ahead[min(index + _LOOKAHEAD, len(ahead) - 1)] - ahead[index]
        level = np.array([beyond[0], beyond[1], 0.0])
        if np.linalg.norm(level) < self.cell_m:
            return make_pose(here[:3, :3], ahead[index])
        return look_at(ahead[index], ahead[index] + level)

    def gain_of(self, poses: Float64) -> Float64:
        """Expected gain (N,) of poses (N, 4, 4), m^3."""
        return expected_gain(self.map.grid, poses, self.robot.intrinsics)

    def is_new(self, goals: Float64, here: Float64) -> NDArray[np.bool_]:
        """Which goals (N, 4, 4) are neither at the camera's pose (4, 4) nor done with."""
        known = np.concatenate([here[None], self.done_with])
        away = [distance_in_steps(goals, pose, *self.steps).sum(axis=1) for pose in known]
        return np.asarray(np.min(away, axis=0) >= ARRIVED)

    def choose_goal(self, here: Float64) -> Float64:
        """The goal pose (4, 4) with the best gain for its distance from ``here`` (4, 4)."""
        poses, worth = self.drawn_goals(here)
        return poses[np.argmax(worth * self.is_new(poses, here))]

    def drawn_goals(self, here: Float64) -> tuple[Float64, Float64]:
        """Poses (N, 4, 4) drawn as nearby goals, and their gain weighted by distance (N,), m^3."""
        drawn = self.rng.integers(len(self.ways.positions), size=self.goals)
        lengths = np.concatenate([np.zeros(self.goals // 3), self.ways.lengths[drawn]])
        positions = np.concatenate(
            [np.repeat(here[None, :3, 3], self.goals // 3, axis=0), self.ways.positions[drawn]]
        )
        poses = views_anywhere(self.rng, positions)
        turns = distance_in_steps(poses, here, *self.steps)[:, 1]
        steps = 1 + np.maximum(lengths / self.steps[0], turns)
        return poses, self.gain_of(poses) * np.exp(-self.cost * steps / 6)

    def far_goal(self, here: Float64, otherwise: Float64) -> Float64:
        """The pose (4, 4) with the most gain per step; ``otherwise`` if none gains enough."""
        drawn = self.rng.integers(len(self.ways.positions), size=2 * self.goals)
        poses = views_anywhere(self.rng, self.ways.positions[drawn])
        gain = self.gain_of(poses) * self.is_new(poses, here)
        best = int(np.argmax(gain / (self.replan + self.ways.lengths[drawn] / self.steps[0])))
        return poses[best] if gain[best] >= self.enough_m3 else otherwise

    def near_loss(self, poses: Float64) -> NDArray[np.bool_]:
        """Which of poses (n, 4, 4) are near one where tracking was lost."""
        near = np.zeros(len(poses), dtype=bool)
        for lost in self.lost_at:
            near |= distance_in_steps(poses, lost, *self.steps).max(axis=1) <= KEPT_AWAY
        return near

    @abstractmethod
    def motion_towards(self, goal: Float64) -> int:
        """The next motion towards a goal (4, 4)."""


def _nearest(positions: Float64, position: Float64) -> int:
    """Index of the position (N, 3) nearest to another (3,)."""
    return int(np.argmin(((positions - position) ** 2).sum(axis=1)))
