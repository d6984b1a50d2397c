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
"""Larger motions lead to views without a common part: each is then predicted separately (see
`ViewPredictor`), at the cost of the first."""
_AT_ONCE = 6  # such motions evaluated together


class NextBestView(GoalPlanner):
    """Goes where most unknown space can be seen, by motions that SLAM can follow.

    On the way it takes the motion that best combines progress to the goal with gain of its own,
    among those whose predicted view shows enough of the map, is not too near, and is unlikely to
    make SLAM slip.

    Args:
        robot: the robot's view.
        seed: for drawing goals.
        overlap: share of a view that the map should fill.
        risk: slip probability permitted per frame, see `trackability`; doubled with each
            consecutive goal that could not be approached.
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
        """Frames per motion; each has its share of the motion and its own slip risk."""
        return self.robot.frames_per_motion

    def motion_towards(self, goal: Float64) -> int:
        """The admissible motion with the best progress to a goal (4, 4) and gain of its own."""
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
        """Which motions to poses (n, 4, 4) SLAM can follow; if none, all possible ones.

        Staying and pure roll are excluded unless nothing else is admissible. With an ``order`` (n,)
        only the motions up to the first admissible one are tested.
        """
        possible = self.robot.action_masks()
        permitted = possible & ~self.near_loss(poses)
        leads = leads_on(poses, self.robot.T_world_camera_estimate)
        risk = min(self.risk * 2**self.given_up, 1.0)
        self.seen_risks = risks = np.full(len(poses), np.inf)
        for some in _in_turn(order, permitted, leads):
            risks[some] = self.risks(poses[some], permitted[some])
            if bearable(risk, risks, leads) == risk:
                break  # the risks of the others do not affect these
        can = risks <= bearable(risk, risks, leads)
        moving = can & leads
        can = moving if moving.any() else can
        return can if can.any() else possible

    def risks(self, poses: Float64, permitted: NDArray[np.bool_]) -> Float64:
        """Slip risk (n,) of the motions to poses (n, 4, 4), from predicted views.

        Infinite for motions that are not permitted or lead to views that SLAM cannot follow.
        """
        seen_from = np.concatenate([self.robot.T_world_camera_estimate[None], poses])
        views = self.robot.predict(seen_from, SCALE)
        return follow_risks(views, seen_from, np.r_[True, permitted], self.overlap, self.frames)[1:]


def _in_turn(
    order: NDArray[np.int64] | None, permitted: NDArray[np.bool_], leads_on: NDArray[np.bool_]
) -> list[NDArray[np.int64]]:
    """Groups of motions to evaluate together: all, or a few at a time, rolls last."""
    if order is None:
        return [np.arange(len(permitted))]
    order = order[permitted[order]]
    order = order[np.argsort(~leads_on[order], kind="stable")]
    return np.split(order, range(_AT_ONCE, len(order), _AT_ONCE))
