"""The reward: named terms, one weighted sum."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.config import Checked, Named, bounded
from ms_slam_env.errors import InputError

DIVERGENCE_AND_ERROR = "divergence-and-error"
"""Name of the reward of every environment without a task."""

MAPPING = "mapping"
"""Name of the reward of the tasks."""

DEFAULT = "default"
"""Name of the environment's own reward, one of these two."""

_DISTANCE_CAP = 0.4  # in units of M: one violent frame must not outweigh a whole episode
_ERROR_CAP_M = 0.1  # a lost camera's error is arbitrary; the terms for lost tracking penalize it


@dataclass(frozen=True)
class TargetConfig(Checked):
    """Motion-and-structure parameters and thresholds of the paper's Algorithm 1, line 9.

    M_I and M_D are medians, over hand-held sequences, of the maximum divergence when every twelfth
    frame is kept, the largest spacing that SLAM tracked without a loss
    (``ms-slam experiment frame_skipping``). The thresholds and lambda were chosen on validation
    seeds: with larger ones the greedy planner loses track like a random walk, with smaller ones it
    maps little.

    Attributes:
        M_I: permitted maximum of the intensity divergence, equation (11), nats.
        M_D: permitted maximum of the depth divergence, equation (12), nats.
        rho_I: share of M_I to aim at, in [0, 1]; 0 keeps the camera almost still.
        rho_D: share of M_D to aim at, in [0, 1].
        depth_weight: lambda, significance of depth over intensity.
    """

    M_I: float = bounded(0.15, 1e-6, 100)
    M_D: float = bounded(0.36, 1e-6, 100)
    rho_I: float = bounded(0.07, 0, 1)
    rho_D: float = bounded(1 / 6, 0, 1)
    depth_weight: float = bounded(0.1, 0, 1e6)

    @property
    def maxima(self) -> NDArray[np.float64]:
        """(M_I, M_D)."""
        return np.array([self.M_I, self.M_D])

    @property
    def divergence(self) -> NDArray[np.float64]:
        """The divergences to aim at, (rho_I M_I, rho_D M_D)."""
        return np.array([self.rho_I * self.M_I, self.rho_D * self.M_D])

    def distances(self, divergences: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances of divergences (..., 2), nats, from their targets, in units of (M_I, M_D)."""
        return np.abs(divergences - self.divergence) / self.maxima


@dataclass(frozen=True)
class RewardConfig(Checked, Named):
    """Weights of the reward terms; see :func:`reward_terms` for each term.

    The defaults are those of ``divergence-and-error``: move as the divergence targets ask, keep the
    trajectory error small, do not get lost. ``mapping`` pays for new surface, which tasks ask for.
    ``paper`` has neither costs of getting lost nor the whole trajectory's error: only the
    distances to the targets and the growth of the pose error.

    Attributes:
        intensity_divergence: per M_I of distance to the intensity target.
        depth_divergence: per M_D of distance to the depth target (times lambda).
        ate_growth: per metre of growth of the ATE, the RMSE of the positions so far. The terms of
            an episode sum to minus this weight times the final ``info["ate"]``.
        trajectory_error: per metre of growth of the pose error, so that an episode's terms sum to
            the last frame's error alone, less what exceeds the cap.
        new_surface: per square metre of surface newly mapped in its true place.
        lost: per step with tracking lost.
        lost_for_good: once, when the episode ends because tracking was lost beyond recovery.
        blocked: per masked action chosen.
        compute: per unit of the SLAM configuration's cost, where the agent chooses it
            (``MSActiveSLAM-Adaptive-v0``).
    """

    intensity_divergence: float = bounded(0.5, 0, 1e6)
    depth_divergence: float = bounded(0.5, 0, 1e6)
    ate_growth: float = bounded(100.0, 0, 1e6)
    trajectory_error: float = bounded(0.0, 0, 1e6)
    new_surface: float = bounded(0.0, 0, 1e6)
    lost: float = bounded(0.5, 0, 1e6)
    lost_for_good: float = bounded(30.0, 0, 1e6)
    blocked: float = bounded(0.1, 0, 1e6)
    compute: float = bounded(0.1, 0, 1e6)

    @classmethod
    def named(cls) -> Mapping[str, RewardConfig]:
        """The named weights."""
        error = cls(ate_growth=0.0, trajectory_error=10.0)
        unasked = ("lost", "lost_for_good", "blocked", "compute")
        return {
            DIVERGENCE_AND_ERROR: cls(),
            MAPPING: replace(error, new_surface=1.0, lost_for_good=10.0),
            "paper": replace(error, **dict.fromkeys(unasked, 0.0)),
        }


@dataclass(frozen=True)
class Outcome:
    """The outcome of one step, or of one step of each of B environments (``weighted_terms``).

    Attributes:
        divergence: (2,) intensity and depth divergence between the last two live frames.
        pose_error_growth_m: change of the distance between true and estimated position.
        ate_growth_m: change of ``info["ate"]``.
        new_surface_m2: surface newly mapped in its true place.
        tracking_ok: whether the frame was tracked.
        lost_for_good: whether the episode ends because tracking was lost beyond recovery.
        blocked: whether the action was masked and so did nothing.
        configuration_cost: cost of the SLAM configuration, if the agent chooses it.
    """

    divergence: NDArray[np.float64]
    pose_error_growth_m: float
    ate_growth_m: float
    new_surface_m2: float
    tracking_ok: bool
    lost_for_good: bool
    blocked: bool
    configuration_cost: float | None = None


Reward = Callable[[Outcome], "float | Mapping[str, float]"]
"""A user-defined reward."""


def reward_terms(
    outcome: Outcome, weights: RewardConfig | Reward, targets: TargetConfig
) -> dict[str, float]:
    """Weighted terms, name to value; the reward is their sum.

    Instead of weights, a function of the outcome can be given; it returns terms by name, or one
    number.

    The two divergence terms are the summands of Algorithm 1, line 9, in units of M_I and M_D so
    that one weight suits every scene. Their targets are above 0: a camera at rest misses them.
    No other term of ``divergence-and-error`` is positive, so a lost episode must not save what the
    rest of it would have cost: ``lost`` is more than the largest distances of a step, and
    ``lost_for_good`` with it more than those of 150 steps.
    With ``mapping`` surface newly mapped in its true place is the goal: neither standing still nor
    getting lost earns any. The error terms penalize at once what would cost surface only later.
    """
    if not isinstance(weights, RewardConfig):
        value = weights(outcome)
        terms = value if isinstance(value, Mapping) else {"reward": value}
        try:
            return _without_minus_zero({name: float(term) for name, term in terms.items()})
        except (TypeError, ValueError):
            raise InputError(
                f"reward {weights!r} returned {value!r}; it must return a number, or a mapping of "
                "names to numbers"
            ) from None
    terms = {name: float(term) for name, term in weighted_terms(outcome, weights, targets).items()}
    if outcome.configuration_cost is not None:
        terms["compute"] = -weights.compute * outcome.configuration_cost
    return _without_minus_zero(terms)


def weighted_terms(
    outcome: Outcome, weights: RewardConfig, targets: TargetConfig
) -> dict[str, Any]:
    """The terms of `reward_terms` that every environment has, of one outcome or of B.

    Of B outcomes the fields of ``outcome`` are arrays (B,), divergences (B, 2), and so the terms.
    """
    capped = np.minimum(targets.distances(outcome.divergence), _DISTANCE_CAP)
    growth = np.clip(outcome.pose_error_growth_m, -_ERROR_CAP_M, _ERROR_CAP_M)
    return {
        "intensity_divergence": -weights.intensity_divergence * capped[..., 0],
        "depth_divergence": -weights.depth_divergence * targets.depth_weight * capped[..., 1],
        "ate_growth": -weights.ate_growth * outcome.ate_growth_m,
        "trajectory_error": -weights.trajectory_error * growth,
        "new_surface": weights.new_surface * outcome.new_surface_m2,
        "lost": -weights.lost * np.logical_not(outcome.tracking_ok),
        "lost_for_good": -weights.lost_for_good * np.asarray(outcome.lost_for_good),
        "blocked": -weights.blocked * np.asarray(outcome.blocked),
    }


def _without_minus_zero(terms: dict[str, float]) -> dict[str, float]:
    """Replace -0.0 by 0.0, since the two are written differently."""
    return {name: term + 0.0 for name, term in terms.items()}
