"""Next best view with a receding horizon: makes one motion and chooses again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ms_slam_baselines.nbv import NextBestView

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.planning.view_goals import best_goal

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


class RecedingNextBestView(NextBestView):
    """`nbv` with a receding horizon: searches for the best view after every motion.

    As in Bircher et al. (ICRA 2016), only the first part of the path to the best view is executed,
    so that new surface is used at once. Nearby views are compared by
    `planning.view_goals.best_goal`, which is deterministic: the goal stays until a better one is
    found. If the best gains too little, it continues as `nbv`, to far goals that it keeps.

    Args:
        robot: the robot's view.
        seed: for drawing far goals.
        enough_m3: unknown volume that a nearby goal should show; if it is too large, the planner
            leaves for far goals too soon.
        **options: see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self, robot: RobotView, seed: int = 0, enough_m3: float = 0.3, **options: Any
    ) -> None:
        super().__init__(robot, seed, enough_m3=enough_m3, **options)

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self.is_near = False

    goal: Float64 | None

    def find_goal(self, here: Float64) -> None:
        """Choose the best nearby goal, reached in a straight line, or the goal of `nbv`."""
        best = best_goal(self.map.grid, here, self.robot.intrinsics, self.steps)
        is_enough = bool(self.gain_of(best[None])[0] >= self.enough_m3)
        self.is_near = not self.must_leave(here) and is_enough
        if self.is_near:
            self.goal, self.way, self.age = best, best[None, :3, 3], 0
        else:
            super().find_goal(here)

    def judge_goal(self, here: Float64) -> None:
        """Drop a nearby goal, so that the next choice uses the new surface."""
        if self.is_near:
            self.goal = None
        else:
            super().judge_goal(here)
