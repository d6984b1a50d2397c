"""Kullback-Leibler divergence of whole-image histograms: the paper's measure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.divergence.base import Divergence

Float64 = NDArray[np.float64]


def kl_divergence(p: Float64, q: Float64) -> Float64:
    """KL(p || q) (...) in nats of positive distributions (..., K), equation (4)."""
    divergence = np.einsum("...k,...k->...", p, np.log(p) - np.log(q))
    return np.maximum(divergence, 0.0)  # rounding can make it -1e-17


class KLDivergence(Divergence):
    """Equations (5) and (10) of Saeedi et al., ICRA 2017."""

    def compare_intensity(self, current: Float64, reference: Float64) -> Float64:
        """Equation (5), averaged over the windows (one window here)."""
        return kl_divergence(current, reference).mean(axis=1)

    def compare_normals(self, current: Float64, reference: Float64) -> Float64:
        """Equation (10), averaged over the windows (one window here)."""
        return kl_divergence(current, reference).mean(axis=1)
