"""The reward: named terms, one weighted sum."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.env.config import RewardConfig, TargetConfig

_DISTANCE_CAP = 0.4  # in units of M: one violent frame must not outweigh a whole episode
_ERROR_CAP_M = 0.1  # a lost camera's error is arbitrary; the terms for lost tracking judge it


@dataclass(frozen=True)
class Outcome:
    """What one step led to.

    Attributes:
        divergence: (2,) intensity and depth divergence between the last two live frames.
        pose_error_growth_m: change of the distance between true and estimated position.
        new_surface_m2: surface newly mapped in its true place.
        tracking_ok: whether the frame was tracked.
        lost_for_good: whether the episode ends because tracking was lost beyond recovery.
        blocked: whether the action was masked and so did nothing.
        configuration_cost: of the SLAM configuration, if the agent chooses it.
    """

    divergence: NDArray[np.float64]
    pose_error_growth_m: float
    new_surface_m2: float
    tracking_ok: bool
    lost_for_good: bool
    blocked: bool
    configuration_cost: float | None = None


Reward = Callable[[Outcome], "float | Mapping[str, float]"]
"""A reward of a user's own."""


def reward_terms(
    outcome: Outcome, weights: RewardConfig | Reward, targets: TargetConfig
) -> dict[str, float]:
    """Weighted terms, name to value; the reward is their sum.

    Instead of weights, a function of the outcome may say them: terms by name, or one number.

    The two divergence terms are the summands of Algorithm 1, line 9, in units of M_I and M_D so
    that one weight serves every scene; they alone would make an agent imitate the greedy planner.
    Surface newly mapped in its true place is what a user wants from the camera: neither standing
    still nor getting lost gathers any. The error terms say at once what lost surface says late.
    """
    if not isinstance(weights, RewardConfig):
        value = weights(outcome)
        terms = value if isinstance(value, Mapping) else {"reward": value}
        return _without_minus_zero({name: float(term) for name, term in terms.items()})
    intensity, depth = np.minimum(targets.distances(outcome.divergence), _DISTANCE_CAP)
    growth = float(np.clip(outcome.pose_error_growth_m, -_ERROR_CAP_M, _ERROR_CAP_M))
    terms = {
        "intensity_divergence": -weights.intensity_divergence * float(intensity),
        "depth_divergence": -weights.depth_divergence * targets.depth_weight * float(depth),
        "trajectory_error": -weights.trajectory_error * growth,
        "new_surface": weights.new_surface * outcome.new_surface_m2,
        "lost": -weights.lost * float(not outcome.tracking_ok),
        "lost_for_good": -weights.lost_for_good * float(outcome.lost_for_good),
        "blocked": -weights.blocked * float(outcome.blocked),
    }
    if outcome.configuration_cost is not None:
        terms["compute"] = -weights.compute * outcome.configuration_cost
    return _without_minus_zero(terms)


def _without_minus_zero(terms: dict[str, float]) -> dict[str, float]:
    """The same terms; what counts nothing is 0.0, which -0.0 is written differently from."""
    return {name: term + 0.0 for name, term in terms.items()}
