"""What aligning frames with the map found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.slam.surfel.blank import BLANK
from ms_slam_env.slam.surfel.verdict import FEW_POINTS, OK

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Alignment:
    """What ``Tracker.align`` found for B envs.

    Attributes:
        T_world_live: (B, 4, 4) pose after alignment, good or not.
        T_model_live: (B, 4, 4) the same, relative to the pose of the model view.
        verdict: (B,) codes of ``verdict.REASONS``; 0 = tracked.
        stats: (B, NUM_STATS) figures behind the verdict.
        photometry: (B,) how the live grey values relate to the model's, ``Photometry`` each.
        covariance: (B, 6, 6) of the twist (rho, phi), metres and radians, with the true pose
            T_world_live exp(twist).
    """

    T_world_live: Float64
    T_model_live: Float64
    verdict: NDArray[np.int32]
    stats: Float64
    photometry: NDArray[Any]
    covariance: Float64

    def replace(self, where: NDArray[np.bool_], other: Alignment) -> Alignment:
        """Take the envs ``where`` (B,) from ``other``."""
        return Alignment(
            T_world_live=np.where(where[:, None, None], other.T_world_live, self.T_world_live),
            T_model_live=np.where(where[:, None, None], other.T_model_live, self.T_model_live),
            verdict=np.where(where, other.verdict, self.verdict),
            stats=np.where(where[:, None], other.stats, self.stats),
            photometry=np.where(where, other.photometry, self.photometry),
            covariance=np.where(where[:, None, None], other.covariance, self.covariance),
        )


def accept_any_fit(alignment: Alignment) -> Alignment:
    """The same with a good verdict wherever there was something to align at all."""
    usable = (alignment.verdict != FEW_POINTS) & (alignment.verdict != BLANK)
    usable &= np.isfinite(alignment.T_world_live).all(axis=(1, 2))
    unusable = np.where(alignment.verdict == BLANK, BLANK, FEW_POINTS)
    return replace(alignment, verdict=np.where(usable, OK, unusable).astype(np.int32))
