"""Greedy divergence: Algorithm 1 of Saeedi et al., ICRA 2017."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import check_range
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.env import Planner
from ms_slam_env.env.env_config import LookaheadConfig, TargetConfig
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.errors import InputError, unknown

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView


PRESETS = ("environment", "paper")
PAPER_LOOKAHEAD = LookaheadConfig(reference="live", scale=1.0, projection="exact")
PAPER_TARGETS = TargetConfig(M_I=0.19, M_D=0.25, rho_I=1.0, rho_D=1.0, depth_weight=1.0)
"""M_I and M_D determined as for `TargetConfig`, but with the paper's histograms
(``ms-slam experiment frame_skipping --histograms paper``). The paper gives no rho and no lambda: at
1 "the camera moves to the locations where the image will provide maximum allowed information"."""

_FLOOR_NATS = 0.002  # smaller divergences are not distinguished


class GreedyDivergence(Planner):
    """Takes the motion whose predicted divergences come closest to their targets.

    With targets of zero it stands still, as the paper says of rho = 0, because no view diverges
    less from the current one than itself. It explores only with targets above zero.

    Args:
        robot: the robot's view; its environment's targets are the defaults below.
        seed: unused; the planner is deterministic.
        preset: ``environment`` predicts, compares and aims as the environment is configured;
            ``paper`` as Algorithm 1 is printed: the map projected for each candidate, at full size,
            against the last live frame, 256 bins of all pixels, not smoothed, and targets for this
            measure.
        rho_I: share of M_I to aim at, in [0, 1].
        rho_D: share of M_D to aim at, in [0, 1].
        depth_weight: lambda, significance of depth over intensity.
        calibration: rate in [0, 1] at which a factor of the predictions follows the ratio of
            measured to predicted divergence, in logarithms, per motion; 0, as in the paper: none.

    Raises:
        InputError: an option out of its range.
    """

    motions_only = True

    def __init__(
        self,
        robot: RobotView,
        seed: int = 0,
        preset: str = "environment",
        rho_I: float | None = None,
        rho_D: float | None = None,
        depth_weight: float | None = None,
        calibration: float = 0.0,
    ) -> None:
        super().__init__(robot, seed)
        self.calibration = calibration
        check_range(self, "calibration", 0, 1)
        if preset not in PRESETS:
            raise unknown("preset of greedy", preset, PRESETS)
        options = {"rho_I": rho_I, "rho_D": rho_D, "depth_weight": depth_weight}
        given: dict[str, Any] = {k: _number(v) for k, v in options.items() if v is not None}
        self.predicted = self.robot.lookahead
        targets = self.robot.targets
        if preset == "paper" and calibration:
            raise InputError("greedy calibrates what it meets: preset=environment only")
        if preset == "paper":
            self.predicted, targets = self._predicted_as_printed, PAPER_TARGETS
            measure, camera = DivergenceConfig.paper(), self.robot.intrinsics
            self._lookahead = Lookahead(PAPER_LOOKAHEAD, measure, camera)
        self.targets = replace(targets, **given)
        self.reset()

    def reset(self) -> None:
        """Reset the factors of the predictions."""
        self.log_factor = np.zeros(2)
        self._expected: Float64 | None = None

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Algorithm 1; the loop over candidates, lines 3 to 8, is one batch."""
        if self.calibration and self._expected is not None and info["tracking_ok"]:
            self.learn(self._expected, info["divergence"])
        T = np.flatnonzero(self.robot.action_masks())  # line 2: possible motions
        predicted = self.predicted()[T]  # lines 1 and 3 to 8: predict and compare
        delta_I, delta_D = (predicted * np.exp(self.log_factor)).T
        i_star = np.argmin(distance_to_targets(delta_I, delta_D, self.targets))  # line 9
        self._expected = predicted[i_star]
        return int(T[i_star])  # lines 10 and 11

    def learn(self, predicted: Float64, met: Float64) -> None:
        """Move the factors (2,) towards the ratio of ``met`` to ``predicted`` (2,), nats."""
        ratio = np.log((met + _FLOOR_NATS) / (predicted + _FLOOR_NATS))
        self.log_factor += self.calibration * (ratio - self.log_factor)

    def instead(self, action: int) -> None:
        """Drop the prediction, since another motion was made."""
        self._expected = None

    def lost_by(self, action: int) -> None:
        """Drop the prediction, since no divergence was measured."""
        self._expected = None

    def _predicted_as_printed(self) -> Float64:
        """Divergences (n, 2) of the predicted images from I_t-1 and D_t-1, the last live ones."""
        robot = self.robot
        here, poses = robot.T_world_camera_estimate, robot.candidate_poses()
        return self._lookahead.divergences(robot, poses, here, robot.last_frame)


def distance_to_targets(delta_I: Float64, delta_D: Float64, targets: TargetConfig) -> Float64:
    """Criterion of line 9: |Delta_I - rho_I M_I| + lambda |Delta_D - rho_D M_D|, (n,) nats.

    ``argmin`` of it breaks ties by the lowest action.
    """
    target_I, target_D = targets.divergence
    return np.abs(delta_I - target_I) + targets.depth_weight * np.abs(delta_D - target_D)


def _number(value: float | str) -> float | str:
    """Convert text to a number; other text is returned for the config to refuse."""
    try:
        return float(value)
    except ValueError:
        return value
