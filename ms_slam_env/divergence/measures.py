"""Divergence measures: Kullback-Leibler, its mean over windows, earth mover's distance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.divergence.counting import HistogramCounter, Histograms
from ms_slam_env.divergence.sphere import bin_directions


class Divergence(HistogramCounter, ABC):
    """Computes histograms of frames, and their divergence in intensity and depth."""

    def divergence(self, current: Histograms, reference: Histograms) -> Float64:
        """Intensity and depth divergence (B, 2) of B frames from one or B reference frames."""
        return np.stack(
            [
                self.compare_intensity(current.intensity, reference.intensity),
                self.compare_normals(current.normals, reference.normals),
            ],
            axis=1,
        )

    @abstractmethod
    def compare_intensity(self, current: Float64, reference: Float64) -> Float64:
        """Intensity divergence (B,) of histograms (B, W, K) from (1 or B, W, K)."""

    @abstractmethod
    def compare_normals(self, current: Float64, reference: Float64) -> Float64:
        """Depth divergence (B,) of histograms of normals (B, W, L) from (1 or B, W, L)."""


def kl_divergence(p: Float64, q: Float64) -> Float64:
    """KL(p || q) (...) in nats of positive distributions (..., K), equation (4)."""
    divergence = np.einsum("...k,...k->...", p, np.log(p) - np.log(q))
    return np.maximum(divergence, 0.0)  # rounding can give -1e-17


class KLDivergence(Divergence):
    """Equations (5) and (10) of Saeedi et al., ICRA 2017."""

    def compare_intensity(self, current: Float64, reference: Float64) -> Float64:
        """Equation (5), averaged over the windows (one window here)."""
        return kl_divergence(current, reference).mean(axis=1)

    def compare_normals(self, current: Float64, reference: Float64) -> Float64:
        """Equation (10), averaged over the windows (one window here)."""
        return kl_divergence(current, reference).mean(axis=1)


class WindowedKLDivergence(KLDivergence):
    """KL divergence averaged over the windows of a ``config.windows`` grid.

    "Introducing spatial windowing across the image for histogram generation" (Saeedi et al., ICRA
    2017, section VII): images with equal histograms but moved content then differ. The counter
    splits the image; the base class averages over windows.
    """


def earth_movers_1d(p: Float64, q: Float64) -> Float64:
    """Earth mover's distance (...) of distributions (..., K) over K equal bins of [0, 1].

    In one dimension it is the area between the cumulative distributions.
    """
    return np.abs(np.cumsum(p - q, axis=-1)[..., :-1]).sum(axis=-1) / p.shape[-1]


class SphereTransport:
    """Optimal transport between distributions over fixed directions, with the angle as distance.

    A linear program, solved exactly by HiGHS' dual simplex. Since the angle is a metric, the common
    part of two distributions does not move: bins with a surplus are sources, the others sinks, at
    most L^2 / 4 variables. It takes 2 ms per pair with 22 bins and 7 ms with 86, on one core.
    """

    def __init__(self, directions: Float64) -> None:
        """Prepare for unit vectors (L, 3)."""
        self.angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))

    def distance(self, p: Float64, q: Float64) -> Float64:
        """Distance (B,) in radians between distributions (B, L) and (1 or B, L)."""
        return np.array([self._cost(row) for row in np.atleast_2d(p - q)])

    def _cost(self, difference: Float64) -> float:
        """Least sum of mass times angle that balances a difference (L,) of distributions."""
        sources, sinks = np.flatnonzero(difference > 0), np.flatnonzero(difference < 0)
        if not (len(sources) and len(sinks)):
            return 0.0
        m, n = len(sources), len(sinks)
        arc = np.arange(m * n)
        rows = np.concatenate([arc // n, m + arc % n])
        moved = coo_array((np.ones(2 * m * n), (rows, np.concatenate([arc, arc]))))
        given, taken = difference[sources], -difference[sinks]
        masses = np.concatenate([given, taken * (given.sum() / taken.sum())])  # rounding
        costs = self.angles[np.ix_(sources, sinks)].ravel()
        # One equation follows from the others.
        found = linprog(costs, A_eq=moved.tocsr()[:-1], b_eq=masses[:-1], method="highs-ds")
        if found.x is None:
            raise RuntimeError(f"earth mover's distance: {found.message}")
        return max(0.0, float(found.fun))


class EarthMoversDivergence(Divergence):
    """Earth mover's distance; tolerates small light changes, which move grey levels by few bins.

    "Using the Earth mover's distance to provide tolerance to small illumination changes"
    (Saeedi et al., ICRA 2017, section VII). Intensity: share of the grey range; normals: radians.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Also prepare the ground distance between the bins."""
        super().__init__(*args, **kwargs)
        self._transport = SphereTransport(bin_directions(self.config.inclinations))

    def compare_intensity(self, current: Float64, reference: Float64) -> Float64:
        """Exact one-dimensional distance, as a share of the grey range."""
        return earth_movers_1d(current[:, 0], reference[:, 0])

    def compare_normals(self, current: Float64, reference: Float64) -> Float64:
        """Exact distance on the sphere, radians."""
        return self._transport.distance(current[:, 0], reference[:, 0])
