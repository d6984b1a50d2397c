"""Next best view that makes one motion and looks again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ms_slam_baselines.nbv import NextBestView

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.planning.view_goals import best_goal

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


class RecedingNextBestView(NextBestView):
    """`nbv` with a receding horizon: the best view is looked for anew after every motion.

    As Bircher et al. (ICRA 2016) do: only the first part of the way to the best view is gone, so
    that what it shows counts at once. Views near by are compared by `mapping.view_goals.best_goal`,
    which draws none at random: the goal stays while nothing better is found. Where the best of them
    gains too little it goes on as `nbv`, to far goals that it keeps.

    Args:
        robot: what it sees.
        seed: of the far goals drawn.
        enough_m3: unknown volume that a goal near by should show; more, and it leaves for far goals
            too soon.
        **options: see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self, robot: RobotView, seed: int = 0, enough_m3: float = 0.3, **options: Any
    ) -> None:
        super().__init__(robot, seed, enough_m3=enough_m3, **options)

    def reset(self) -> None:
        """Nothing is known yet."""
        super().reset()
        self.is_near = False

    goal: Float64 | None

    def find_goal(self, here: Float64) -> None:
        """Take the best goal near by, straight ahead, or what `nbv` takes."""
        best = best_goal(self.map.grid, here, self.robot.intrinsics, self.steps)
        is_enough = bool(self.gain_of(best[None])[0] >= self.enough_m3)
        self.is_near = not self.must_leave(here) and is_enough
        if self.is_near:
            self.goal, self.way, self.age = best, best[None, :3, 3], 0
        else:
            super().find_goal(here)

    def judge_goal(self, here: Float64) -> None:
        """Drop a goal near by: the next is found from what its motion has shown."""
        if self.is_near:
            self.goal = None
        else:
            super().judge_goal(here)
