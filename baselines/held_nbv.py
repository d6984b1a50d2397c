"""Next best view by repeated motions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.nbv import NextBestView

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.planning import held_gain

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


_CHOICE = (
    0.05  # share of the best motion's volume: a motion with so much less is 1/e as good a choice
)


class HeldNextBestView(NextBestView):
    """Makes the motion that would show most if repeated for some steps, then chooses again.

    Like MBPlanner (Dharmadhikari et al., ICRA 2020) it compares motion primitives, not poses. The
    volume shown by all views on the way counts, each part of space once, and sooner counts more.
    Only motions that SLAM can follow are considered (see `nbv`). If none shows enough, it goes to a
    goal as `nbv` does.

    Args:
        robot: the robot's view.
        seed: for drawing goals.
        horizon: steps for which a motion is repeated.
        discount: factor per further step.
        least_m3: unknown volume that a motion should show, discounted.
        enough_m3: unknown volume that a nearby goal should show.
        slip_cost: volume in m3 that a slip would cost; a motion's value is reduced by this times
            its slip risk.
        **options: see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self,
        robot: RobotView,
        seed: int = 0,
        horizon: int = 6,
        discount: float = 0.93,
        least_m3: float = 0.1,
        enough_m3: float = 0.3,
        slip_cost: float = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(robot, seed, enough_m3=enough_m3, **options)
        self.horizon, self.discount = horizon, discount
        self.least_m3, self.slip_cost = least_m3, slip_cost
        self.check({"horizon": (1, 100), "discount": (0, 1)}, "horizon")
        self.check({"least_m3": (0, 1000), "slip_cost": (0, 1000)})

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self.weights: Float64 | None = None

    def choose_motion(self, here: Float64) -> int:
        """The admissible motion with the highest value, or the one towards a goal."""
        self.weights = None
        values = self.values(here)
        if not self.must_leave(here) and values.max() >= self.least_m3:
            best = self.best_admissible(self.robot.candidate_poses(), values)
            values = np.where(self.can, values, 0)
            if self.slip_cost:
                values -= self.slip_cost * np.where(self.can, self.seen_risks, 0)
                best = int(np.argmax(values))
            if values[best] >= self.least_m3 and values[best] > 0:
                self.goal, self.given_up = None, 0
                weights = np.exp((values / values[best] - 1) / _CHOICE)
                self.weights = np.where(self.can, weights, 0)
                return best
        return super().choose_motion(here)

    def preferences(self) -> Float64 | None:
        """Probabilities (n,) of the motions, by their value relative to the best one."""
        return None if self.weights is None else self.weights / self.weights.sum()

    def values(self, here: Float64) -> Float64:
        """Discounted volume (n,) in m^3 that each motion shows from a pose (4, 4)."""
        motions = self.robot.candidate_motions()
        gain = held_gain(self.map.grid, here, motions, self.horizon, self.robot.intrinsics)
        return np.asarray(gain @ self.discount ** np.arange(self.horizon))
