"""Quality of a map: its points compared with the true surface.

Every measure of a map goes through `map_quality`, which computes only what is requested::

    map_quality(slam.surface_points(), surface)                            # the planners' measures
    map_quality(slam.surface_points(), surface, ("map_error_median_m",))   # one search, no ICP

Sources: Saeedi et al., ICRA 2017, section II-A (RER, RCM); Knapitsch et al., "Tanks and Temples",
2017 (F-score); Qu et al., "USME", 2021, section 1.2 and equation (7); Sucar et al., "iMAP", 2021.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry.point_clouds import IndexedCloud, indexed, voxel_downsample
from ms_slam_env.metrics.reconstruction import (
    RATIO_THRESHOLD_M,
    harmonic_mean,
    nearest_distances,
    rer,
)

THRESHOLDS_M = (0.02, 0.05)
MAP_VOXEL_M = 0.01  # so that a surface counts by its area, not by how often it was seen
CAP_M = 0.1  # largest distance in the capped RMS, so that a few outliers do not dominate it

_SHARE = re.compile(r"(precision|recall|f_score)_(\d+(?:\.\d+)?)cm")


def share_keys(
    thresholds_m: Sequence[float], kinds: Iterable[str] = ("precision", "recall", "f_score")
) -> tuple[str, ...]:
    """Keys such as ``precision_2cm`` for each threshold in metres.

    Raises:
        InputError: no threshold, or one that is not finite and positive.
    """
    if len(thresholds_m) == 0 or not all(np.isfinite(t) and t > 0 for t in thresholds_m):
        raise InputError(f"thresholds must be finite and > 0 m, got {tuple(thresholds_m)}")
    names = list(kinds)
    return tuple(f"{name}_{100 * t:g}cm" for t in thresholds_m for name in names)


STANDARD = (*share_keys(THRESHOLDS_M), "rcm", "rer_m", "map_points")
"""Measures used to compare planners."""


class ComparedMap:
    """A map and the true surface; distances are computed on first use.

    The map is evaluated where its estimated poses placed it; only RER registers it first.

    Args:
        points: (N, 3) map points, metres; N = 0 is an empty map.
        surface: (M, 3) points of the true surface.
        reference: (K, 3) true points that the map should cover; ``surface`` by default.
        voxel_m: keep one map point per voxel of this side; 0 keeps all.
        registered: whether the map is already registered to the surface; RER is then computed
            without another registration.
    """

    def __init__(
        self,
        points: ArrayLike,
        surface: ArrayLike | IndexedCloud,
        reference: ArrayLike | None = None,
        voxel_m: float = MAP_VOXEL_M,
        registered: bool = False,
    ) -> None:
        given = np.asarray(points)
        self.map_points = len(given)
        self.cloud = voxel_downsample(given, voxel_m) if voxel_m > 0 and len(given) else given
        self.surface = indexed(surface, "truth")
        self.reference = surface if reference is None else reference
        self.registered = registered

    @cached_property
    def to_surface(self) -> Float64:
        """(N,) distance of each map point to the true surface; one NaN for an empty map."""
        return self._search(self.cloud, self.surface)

    @cached_property
    def to_map(self) -> Float64:
        """(K,) distance of each reference point to the map; one NaN for an empty map."""
        return self._search(self.reference, self.cloud)

    def _search(self, points: ArrayLike, target: ArrayLike | IndexedCloud) -> Float64:
        return nearest_distances(points, target) if self.map_points else np.array([np.nan])

    def precision(self, threshold_m: float) -> float:
        """Share of map points closer than this to the true surface; 0 for an empty map."""
        return float((self.to_surface < threshold_m).mean())

    def recall(self, threshold_m: float) -> float:
        """Share of the reference closer than this to the map; 0 for an empty map."""
        return float((self.to_map < threshold_m).mean())

    def f_score(self, threshold_m: float) -> float:
        """Harmonic mean of precision and recall."""
        return harmonic_mean(self.precision(threshold_m), self.recall(threshold_m))

    def rer(self) -> float:
        """RMS distance of map points to the true surface, after ICP; NaN for an empty map."""
        if not self.map_points:
            return float("nan")
        return _rms(self.to_surface) if self.registered else rer(self.cloud, self.surface)

    def measure(self, keys: Iterable[str] = STANDARD) -> dict[str, float]:
        """Measures by key, lengths in metres; distances of an empty map are NaN.

        Raises:
            InputError: an unknown key.
        """
        return {key: self._value(key) for key in keys}

    def _value(self, key: str) -> float:
        share = _SHARE.fullmatch(key)
        if share is not None:
            kind, centimetres = share.groups()
            value: float = getattr(self, kind)(float(centimetres) / 100)
            return value
        if key not in _MEASURES:
            raise unknown("measure of a map", key, [*share_keys(THRESHOLDS_M), *_MEASURES])
        return _MEASURES[key](self)


_MEASURES: Mapping[str, Callable[[ComparedMap], float]] = {
    "map_points": lambda of: of.map_points,
    "rcm": lambda of: of.recall(RATIO_THRESHOLD_M),
    "rer_m": ComparedMap.rer,
    "map_error_median_m": lambda of: float(np.median(of.to_surface)),
    "map_error_capped_rms_m": lambda of: _rms(np.minimum(of.to_surface, CAP_M)),
    "accuracy_cm": lambda of: 100 * float(of.to_surface.mean()),
    "completion_cm": lambda of: 100 * float(of.to_map.mean()),
    "completion_ratio": lambda of: of.recall(RATIO_THRESHOLD_M),
    "c2c_mean_m": lambda of: float(of.to_surface.mean()),
    "c2c_std_m": lambda of: float(of.to_surface.std()),
    "c2c_rms_m": lambda of: _rms(of.to_surface),
    "hausdorff_directed_m": lambda of: float(of.to_surface.max()),
    "hausdorff_m": lambda of: float(max(of.to_surface.max(), of.to_map.max())),
}


def map_quality(
    points: ArrayLike,
    surface: ArrayLike | IndexedCloud,
    keys: Iterable[str] = STANDARD,
    reference: ArrayLike | None = None,
    voxel_m: float = MAP_VOXEL_M,
) -> dict[str, float]:
    """Compare the points (N, 3) of a map with points (M, 3) of the true surface, metres.

    Args:
        points: map points, where the estimated poses placed them.
        surface: true surface, on which map points should lie.
        keys: registry keys: ``precision_2cm``, ``recall_5cm``, ``f_score_10cm`` and so on,
            ``rcm``, ``rer_m``, ``map_error_median_m``, ``map_error_capped_rms_m``, ...
        reference: (K, 3) true points that the map should cover; ``surface`` by default.
        voxel_m: keep one map point per voxel of this side; 0 keeps all.

    Returns:
        the measures by key, in the order of ``keys``; for an empty map, shares are 0 and distances
        NaN.

    Raises:
        InputError: an unknown key, or bad points.
    """
    return ComparedMap(points, surface, reference, voxel_m).measure(keys)


def _rms(distances: Float64) -> float:
    return float(np.sqrt(np.mean(distances**2)))


SURFACE_SPACING_M = 0.02  # of the points that approximate the true surface
_MAP_VOXEL_M = 0.02
_SAMPLES = 5000  # points of map and of reference, for an accuracy of +-1 percentage point


class ScoreCurve:
    """F-score of a map over the steps of an episode.

    Args:
        surface: (M, 3) true surface points, about ``SURFACE_SPACING_M`` apart.
        reference: (K, 3) true points that the map should cover.
        threshold_m: distance within which a point is correct.

    Attributes:
        steps: (S) steps at which the map was evaluated.
        scores: (S) F-scores, from samples of map and reference.
    """

    def __init__(
        self,
        surface: ArrayLike | IndexedCloud,
        reference: Float64,
        threshold_m: float = 0.05,
    ) -> None:
        self._surface = indexed(surface, "surface").tree
        self._reference = _evenly(reference)
        self._threshold_m = threshold_m
        self.steps: list[int] = []
        self.scores: list[float] = []

    def look(self, step: int, points: Float64) -> None:
        """Evaluate the map's ``points`` (N, 3) after a step."""
        self.steps.append(step)
        self.scores.append(self._score(points))

    def area(self, steps: int) -> float:
        """Mean F-score over ``steps``: linear between evaluations, constant after the last one."""
        from scipy.integrate import trapezoid

        scores, at = [*self.scores, self.scores[-1]], [*self.steps, max(steps, self.steps[-1])]
        return float(trapezoid(scores, at)) / max(1, at[-1])

    def _score(self, points: Float64) -> float:
        if not len(points):
            return 0.0
        cloud = voxel_downsample(points, _MAP_VOXEL_M)
        to_surface = self._surface.query(_evenly(cloud), distance_upper_bound=self._threshold_m)[0]
        to_map = IndexedCloud(cloud).tree.query(
            self._reference, distance_upper_bound=self._threshold_m
        )[0]
        precision, recall = (float(np.isfinite(found).mean()) for found in (to_surface, to_map))
        return harmonic_mean(precision, recall)


def _evenly(points: Float64) -> Float64:
    """At most ``_SAMPLES`` of points (N, 3), drawn with a fixed seed."""
    if len(points) <= _SAMPLES:
        return points
    return points[np.random.default_rng(0).choice(len(points), _SAMPLES, replace=False)]
