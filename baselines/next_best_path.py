"""Next best view that counts what the whole way to it shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.view_goals import poses_along
from numpy.typing import NDArray

from ms_slam_env.mapping import way_gain
from ms_slam_env.mapping.view_goals import distance_in_steps

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv

Float64 = NDArray[np.float64]

_STEPS = 20  # of a way that are looked at; what is shown later counts for little


class NextBestPath(NextBestView):
    """Goes to the goal of which the whole way shows most unknown space, the sooner the more.

    As RH-NBVP (Bircher et al., ICRA 2016) sums the gain along a branch of its tree, not that of the
    last view alone. Each part of space counts where it is first seen, exp(-cost) as much six steps
    later.

    Args:
        env: the unwrapped environment.
        seed: of the goals drawn.
        cost: how much less what is seen six steps later is worth: exp(-cost).
        compared: ways, those to the goals that `nbv` would find best.
        **options: see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self,
        env: ActiveSlamEnv,
        seed: int = 0,
        cost: float = 0.35,
        compared: int = 40,
        **options: Any,
    ) -> None:
        super().__init__(env, seed, cost=cost, **options)
        self.compared = compared
        self.check({"compared": (1, 1000)})

    def choose_goal(self, here: Float64) -> Float64:
        """The pose (4, 4) to which the way from ``here`` (4, 4) shows most."""
        poses, worth = self.drawn_goals(here)
        best = np.argsort(-worth * self.is_new(poses, here), kind="stable")[: self.compared]
        ways = np.stack([self.way_to(poses[n], here) for n in best])
        shown = self.shown_by(ways)
        later = np.exp(-self.cost / 6 * np.arange(1, _STEPS + 1))
        return poses[best[np.argmax(shown @ later)]]

    def shown_by(self, ways: Float64) -> Float64:
        """Unknown volume (N, S) in m^3 that each pose of ways (N, S, 4, 4) newly shows."""
        return way_gain(self.map.grid, ways, self.env.intrinsics)

    def way_to(self, goal: Float64, here: Float64) -> Float64:
        """Poses (S, 4, 4) after each step from ``here`` (4, 4) to a goal (4, 4), and then there."""
        known = self.ways.positions
        way = self.ways.to(int(np.argmin(((known - goal[:3, 3]) ** 2).sum(axis=1))))
        way = np.concatenate([here[None, :3, 3], way[1:-1], goal[None, :3, 3]])
        metres = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
        turns = distance_in_steps(here[None], goal, *self.steps)[0, 1]
        steps = max(1.0, metres / self.steps[0], turns)
        return poses_along(way, here, goal, np.minimum(np.arange(1, _STEPS + 1) / steps, 1))
