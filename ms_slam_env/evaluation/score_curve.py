"""How the F-score of a growing map rises, cheaply enough to be asked every few steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.spatial import cKDTree

from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.metrics.reconstruction import harmonic_mean

Float64 = NDArray[np.float64]

SURFACE_SPACING_M = 0.02  # of true surface that stands in for the exact distance
_MAP_VOXEL_M = 0.02
_SAMPLES = 5000  # of the map and of the reference: +-1 percentage point


class ScoreCurve:
    """F-score of a map after each of some steps.

    Args:
        surface: (M, 3) true surface, about ``SURFACE_SPACING_M`` apart.
        reference: (K, 3) true points that the map should have.
        threshold_m: within which a point is right.

    Attributes:
        steps: (S) at which the map was looked at.
        scores: (S) its F-score, by samples of map and reference.
    """

    def __init__(self, surface: Float64, reference: Float64, threshold_m: float = 0.05) -> None:
        self._surface = cKDTree(surface, balanced_tree=False, compact_nodes=False)
        self._reference = _evenly(reference)
        self._threshold_m = threshold_m
        self.steps: list[int] = []
        self.scores: list[float] = []

    def look(self, step: int, points: Float64) -> None:
        """Judge the map's ``points`` (N, 3) after a step."""
        self.steps.append(step)
        self.scores.append(self._score(points))

    def area(self, steps: int) -> float:
        """Mean F-score over ``steps``, linear between looks; after the last one the map stays."""
        scores, at = [*self.scores, self.scores[-1]], [*self.steps, max(steps, self.steps[-1])]
        return float(trapezoid(scores, at)) / max(1, at[-1])

    def _score(self, points: Float64) -> float:
        if not len(points):
            return 0.0
        cloud = voxel_downsample(points, _MAP_VOXEL_M)
        to_surface = self._surface.query(_evenly(cloud), distance_upper_bound=self._threshold_m)[0]
        tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)
        to_map = tree.query(self._reference, distance_upper_bound=self._threshold_m)[0]
        precision, recall = (float(np.isfinite(found).mean()) for found in (to_surface, to_map))
        return harmonic_mean(precision, recall)


def _evenly(points: Float64) -> Float64:
    """At most ``_SAMPLES`` of points (N, 3), drawn from a fixed seed."""
    if len(points) <= _SAMPLES:
        return points
    return points[np.random.default_rng(0).choice(len(points), _SAMPLES, replace=False)]
