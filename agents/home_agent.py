"""An agent that uses a policy for nearby space, and goals for distant space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_agents.policy_planner import SHIPPED, ShippedAgent
from ms_slam_baselines.nbv import NextBestView
from numpy.typing import NDArray

from ms_slam_env.errors import unknown
from ms_slam_env.planning.candidates import GRID_NAMES
from ms_slam_env.planning.trackability import NEAR_SHARE, bearable, leads_on
from ms_slam_env.planning.view_goals import best_goal

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


_REMAINS = 0.3
"""Share of the current view that should remain in the image, or as much as possible."""
_OBSERVATIONS = ("goals", "held")


class HomePolicy(ShippedAgent):
    """The policy of `agent-home`: that of `agent-room`, further trained in homes."""

    default_path = SHIPPED / "home.safetensors"


class HomeAgent(NextBestView):
    """Follows a policy while there is something to see nearby; otherwise goes to goals as `nbv`.

    A policy that sees a few metres around does not find its way to the next room. As in Active
    Neural SLAM (Chaplot et al., ICLR 2020), goals form a level above it: where the best nearby view
    would show too little, or where the policy returns to a visited pose, this planner goes to a
    goal and then hands control back. The policy chooses among the motions that, by its own
    observation, are unlikely to slip, without those that lost tracking before (a shield, Alshiekh
    et al., AAAI 2018): only the current view is predicted from the map.

    Args:
        robot: the robot's view.
        seed: for drawing goals.
        path: policy file; default: the one shipped with the package.
        **options: see `NextBestView`; ``enough_m3`` is what the best nearby view should show.

    Raises:
        InputError: an option out of its range, or a policy that does not fit the environment or
            whose observation lacks the risks.
    """

    def __init__(
        self, robot: RobotView, seed: int = 0, path: str | None = None, **options: Any
    ) -> None:
        self.near = HomePolicy(robot, seed, path)
        super().__init__(robot, seed, **options)
        self.check_policy(self.near.policy.metadata.observation)

    @staticmethod
    def check_policy(observation: str) -> None:
        """Refuse a policy whose observation lacks the risks.

        Raises:
            InputError: naming the observations that have them.
        """
        if observation not in _OBSERVATIONS:
            raise unknown("observation of the policy under agent-home", observation, _OBSERVATIONS)

    @classmethod
    def observation_for(cls, path: str | None = None, **options: Any) -> str:
        """The observation variant that the policy was trained on."""
        return HomePolicy.observation_for(path)

    def reset(self) -> None:
        """Forget the last episode."""
        super().reset()
        self.near.reset()
        self._choices: NDArray[np.bool_] | None = None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Carve the last frame and choose a motion."""
        self.seen = np.asarray(observation)
        return super().act(observation, info)

    def see(self, observation: Any, info: dict[str, Any]) -> None:
        """See the base class."""
        self.near.see(observation, info)

    def choose_motion(self, here: NDArray[np.float64]) -> int:
        """The policy's motion, or the one towards a goal."""
        safe = self.safe_motions(here)
        wanted = self.near.policy.act(self.seen, safe if safe.any() else self.robot.action_masks())
        self._choices = None
        if self.goal is not None:
            self.judge_goal(here)
        if self.goal is None and not self.must_leave(here) and safe.any():
            best = best_goal(self.map.grid, here, self.robot.intrinsics, self.steps)
            if self.gain_of(best[None])[0] >= self.enough_m3:
                self.given_up = 0
                self._choices = safe
        return self.go_to_goal(here) if self._choices is None else int(wanted)

    def choices(self) -> NDArray[np.bool_] | None:
        """The motions unlikely to slip; None on the way to a goal."""
        return self._choices

    def safe_motions(self, here: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which motions (n,) are unlikely to slip, according to the policy's observation."""
        poses = self.robot.candidate_poses()
        rows = self.seen[self.near.policy.metadata.num_state :].reshape(len(poses), -1)
        of = dict(zip(GRID_NAMES, rows.T.astype(np.float64), strict=False))
        can = self.robot.action_masks() & ~self.near_loss(poses)
        can &= of["remains"] >= min(_REMAINS, of["remains"][can].max(initial=0))
        can &= of["near"] <= max(NEAR_SHARE, of["near"][0])
        risks = np.where(can, of["slip_risk"], np.inf)
        return np.asarray(can & (risks <= bearable(self.risk, risks, leads_on(poses, here))))
