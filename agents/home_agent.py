"""A policy for what is near by, and goals for the way to what is not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_agents.policy_planner import RoomAgent
from ms_slam_baselines.nbv import NextBestView
from numpy.typing import NDArray

from ms_slam_env.mapping.view_goals import best_goal

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv


class HomeAgent(NextBestView):
    """The policy of `agent-room` while there is something to see near by; goals as `nbv` has them.

    A policy that sees some metres around does not find its way to the next room. As in Active
    Neural SLAM (Chaplot et al., ICLR 2020) goals are what is above it: where the best view near by
    would show too little, where the policy comes back to where it has been, or wants the motion
    that lost tracking before, this planner goes to a goal and there gives the camera back.

    Args:
        env: the unwrapped environment.
        seed: of the goals drawn.
        path: file of the policy; default: the one that comes with the package.
        **options: see `NextBestView`; ``enough_m3`` is what the best view near by should show.

    Raises:
        InputError: an option out of its range, or a policy that does not fit the environment.
    """

    def __init__(
        self, env: ActiveSlamEnv, seed: int = 0, path: str | None = None, **options: Any
    ) -> None:
        super().__init__(env, seed, **options)
        self.near = RoomAgent(env, seed, path)

    @classmethod
    def observation_for(cls, path: str | None = None, **options: Any) -> str:
        """What the policy was trained on."""
        return RoomAgent.observation_for(path)

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Carve the last frame, choose a motion."""
        self.wanted = int(self.near.act(observation, info))
        return super().act(observation, info)

    def choose_motion(self, here: NDArray[np.float64]) -> int:
        """The policy's motion, or the one towards a goal."""
        if self.goal is not None:
            self.judge_goal(here)
        if self.goal is None and not self.must_leave(here):
            best = best_goal(self.map.grid, here, self.env.intrinsics, self.steps)
            is_safe = not self.near_loss(self.env.candidate_poses())[self.wanted]
            if is_safe and self.gain_of(best[None])[0] >= self.enough_m3:
                self.given_up = 0
                return self.wanted
        return self.go_to_goal(here)
