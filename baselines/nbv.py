"""Next best view under a trackability constraint."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.goal_planner import GoalPlanner
from numpy.typing import NDArray

from ms_slam_env.mapping import expected_gain
from ms_slam_env.mapping.trackability import SCALE, can_follow, leads_on
from ms_slam_env.mapping.view_goals import distance_in_steps

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv

Float64 = NDArray[np.float64]


class NextBestView(GoalPlanner):
    """Goes to where most unknown space can be seen, by motions that SLAM can follow.

    On the way the motion is taken that comes nearest to the goal and sees something itself, among
    those whose predicted view shows enough of the map, is not too near, and is not likely to slip.

    Args:
        env: the unwrapped environment.
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
        env: ActiveSlamEnv,
        seed: int = 0,
        overlap: float = 0.5,
        risk: float = 0.02,
        own_gain: float = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(env, seed, **options)
        self.overlap, self.risk, self.own_gain = overlap, risk, own_gain
        self.frames = env.config.frames_per_action
        self.check({"overlap": (0, 1), "risk": (0, 1), "own_gain": (0, 1000)})

    def motion_towards(self, goal: Float64) -> int:
        """The admissible motion that comes nearest to a goal (4, 4) and gains something itself."""
        poses = self.env.candidate_poses()
        gain = expected_gain(self.map.grid, poses, self.env.intrinsics, (12, 9))
        score = self.own_gain * gain / max(gain.max(), 1e-9)
        score -= distance_in_steps(poses, goal, *self.steps).sum(axis=1)
        score[~self.admissible(poses)] = -np.inf
        return int(np.argmax(score))

    def admissible(self, poses: Float64) -> NDArray[np.bool_]:
        """Which motions to poses (n, 4, 4) SLAM can follow; the possible ones if it could none.

        To stay, or but to roll, is none of them, unless there is no other.
        """
        possible = self.env.action_masks()
        here = self.env.episode.T_world_camera_estimate
        seen_from = np.concatenate([here[None], poses])
        views = self.env.slam.predict(seen_from, SCALE)
        permitted = np.r_[True, possible & ~self.near_loss(poses)]
        risk = min(self.risk * 2**self.given_up, 1.0)
        limits = self.overlap, risk, self.frames
        can = can_follow(views, seen_from, permitted, *limits)[1:]
        moving = can & leads_on(poses, here)
        can = moving if moving.any() else can
        return can if can.any() else possible
