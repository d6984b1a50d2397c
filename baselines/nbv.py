"""Next best view under a trackability constraint."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.goal_planner import GoalPlanner
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.planning import expected_gain
from ms_slam_env.planning.trackability import SCALE, bearable, follow_risks, leads_on
from ms_slam_env.planning.view_goals import distance_in_steps

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


_FAR_APART_RAD = math.radians(16)
"""Motions by more than this lead to views of which none shows what all of them show: each is then
predicted for itself (see `ViewPredictor`), and costs as much as the first."""
_AT_ONCE = 6  # of such motions are looked at together


class NextBestView(GoalPlanner):
    """Goes to where most unknown space can be seen, by motions that SLAM can follow.

    On the way the motion is taken that comes nearest to the goal and sees something itself, among
    those whose predicted view shows enough of the map, is not too near, and is not likely to slip.

    Args:
        robot: what it sees.
        seed: of the goals drawn.
        overlap: share of a view that the map should fill.
        risk: probability that a frame may have to slip, see `trackability`; twice as much with
            each goal in succession that could not be come nearer.
        own_gain: steps that the best view on the way is worth.
        **options: of the goals, see `GoalPlanner`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self,
        robot: RobotView,
        seed: int = 0,
        overlap: float = 0.5,
        risk: float = 0.02,
        own_gain: float = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(robot, seed, **options)
        self.overlap, self.risk, self.own_gain = overlap, risk, own_gain
        self.far_apart = self.steps[1] > _FAR_APART_RAD
        self.check({"overlap": (0, 1), "risk": (0, 1), "own_gain": (0, 1000)})

    @property
    def frames(self) -> int:
        """Frames that a motion has: each has its part of the way, and its risk to slip."""
        return self.robot.frames_per_motion

    def motion_towards(self, goal: Float64) -> int:
        """The admissible motion that comes nearest to a goal (4, 4) and gains something itself."""
        poses = self.robot.candidate_poses()
        gain = expected_gain(self.map.grid, poses, self.robot.intrinsics, (12, 9))
        score = self.own_gain * gain / max(gain.max(), 1e-9)
        score -= distance_in_steps(poses, goal, *self.steps).sum(axis=1)
        return self.best_admissible(poses, score)

    def best_admissible(self, poses: Float64, score: Float64) -> int:
        """The admissible motion to poses (n, 4, 4) with the highest score (n,)."""
        best_first = np.argsort(-score, kind="stable") if self.far_apart else None
        self.can = self.admissible(poses, best_first)
        return int(np.argmax(np.where(self.can, score, -np.inf)))

    def admissible(
        self, poses: Float64, order: NDArray[np.int64] | None = None
    ) -> NDArray[np.bool_]:
        """Which motions to poses (n, 4, 4) SLAM can follow; the possible ones if it could none.

        To stay, or but to roll, is none of them, unless there is no other. With an ``order`` (n,)
        it is said only of the first that is, and of those before it.
        """
        possible = self.robot.action_masks()
        permitted = possible & ~self.near_loss(poses)
        leads = leads_on(poses, self.robot.T_world_camera_estimate)
        risk = min(self.risk * 2**self.given_up, 1.0)
        self.seen_risks = risks = np.full(len(poses), np.inf)
        for some in _in_turn(order, permitted, leads):
            risks[some] = self.risks(poses[some], permitted[some])
            if bearable(risk, risks, leads) == risk:
                break  # what the others risk changes nothing of these
        can = risks <= bearable(risk, risks, leads)
        moving = can & leads
        can = moving if moving.any() else can
        return can if can.any() else possible

    def risks(self, poses: Float64, permitted: NDArray[np.bool_]) -> Float64:
        """Risk (n,) to slip on the motions to poses (n, 4, 4), by the views that the map predicts.

        Infinite where a motion is not permitted or leads to a view that SLAM cannot follow.
        """
        seen_from = np.concatenate([self.robot.T_world_camera_estimate[None], poses])
        views = self.robot.predict(seen_from, SCALE)
        return follow_risks(views, seen_from, np.r_[True, permitted], self.overlap, self.frames)[1:]


def _in_turn(
    order: NDArray[np.int64] | None, permitted: NDArray[np.bool_], leads_on: NDArray[np.bool_]
) -> list[NDArray[np.int64]]:
    """Which motions are looked at together: all, or a few at a time, rolls last."""
    if order is None:
        return [np.arange(len(permitted))]
    order = order[permitted[order]]
    order = order[np.argsort(~leads_on[order], kind="stable")]
    return np.split(order, range(_AT_ONCE, len(order), _AT_ONCE))
