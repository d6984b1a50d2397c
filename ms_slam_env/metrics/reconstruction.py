"""Errors of maps: precision, recall, F-score, reconstruction error (RER), completeness (RCM)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.cloud_registration import CUTOFF_M, register_clouds
from ms_slam_env.geometry.point_clouds import check_points, voxel_downsample

Float64 = NDArray[np.float64]

ICP_POINTS = 5000  # of a map, evenly picked, are enough to place it


@dataclass(frozen=True)
class MapMetrics:
    """Quality of an estimated map against the true surface.

    Attributes:
        precision: threshold in metres -> share of map points that near the true surface.
        recall: threshold -> share of true points that near the map (RCM at that threshold).
        f_score: threshold -> harmonic mean of precision and recall.
        rer_m: RMS distance of map points to the true surface, after the registration asked for.
        rcm: recall at ``rcm_threshold_m``.
    """

    precision: dict[float, float]
    recall: dict[float, float]
    f_score: dict[float, float]
    rer_m: float
    rcm: float


def nearest_distances(points: ArrayLike, truth: ArrayLike) -> Float64:
    """Distance (N,) in metres from each point (N, 3) to its nearest of ``truth`` (M, 3)."""
    tree = cKDTree(check_points(truth, "truth"), balanced_tree=False, compact_nodes=False)
    return tree.query(check_points(points, "points"))[0]


def precision(points: ArrayLike, truth: ArrayLike, threshold_m: float) -> float:
    """Share of ``points`` (N, 3) nearer than ``threshold_m`` to ``truth`` (M, 3)."""
    _check_threshold(threshold_m)
    return float((nearest_distances(points, truth) < threshold_m).mean())


def recall(points: ArrayLike, truth: ArrayLike, threshold_m: float) -> float:
    """Share of ``truth`` (M, 3) nearer than ``threshold_m`` to ``points`` (N, 3)."""
    return precision(truth, points, threshold_m)


def rcm(points: ArrayLike, truth: ArrayLike, threshold_m: float = 0.05) -> float:
    """Reconstruction completeness: share of the true points that the map has, = `recall`.

    Saeedi et al., ICRA 2017, section II-A: "the reconstructed percentage of the ground truth
    points".
    """
    return recall(points, truth, threshold_m)


def f_score(points: ArrayLike, truth: ArrayLike, threshold_m: float) -> float:
    """Harmonic mean of `precision` and `recall` (Knapitsch et al., Tanks and Temples, 2017)."""
    return harmonic_mean(precision(points, truth, threshold_m), recall(points, truth, threshold_m))


def rer(points: ArrayLike, truth: ArrayLike, registration: str = "icp") -> float:
    """Reconstruction error: RMS distance in metres of map points to the nearest true point.

    Saeedi et al., ICRA 2017, section II-A: "determined by running iterative closest point on the
    point cloud models of the world and the map. The error of the point cloud matching is used as
    RER". With ``registration="none"`` the map stays where its estimated poses placed it; the other
    methods are those of `register_clouds`.

    Raises:
        InputError: bad points or an unknown registration.
    """
    cloud, true_cloud = check_points(points, "points"), check_points(truth, "truth")
    return _rms(_registered_distances(cloud, cKDTree(true_cloud), registration))


def map_metrics(
    points: ArrayLike,
    truth: ArrayLike,
    thresholds_m: Sequence[float] = (0.02, 0.05),
    rcm_threshold_m: float = 0.05,
    registration: str = "icp",
    voxel_m: float = 0.01,
) -> MapMetrics:
    """All measures of a map at once, from two k-d trees.

    Precision, recall and F-score judge the map where its estimated poses placed it; only RER
    registers it first. Both clouds are thinned to one point per voxel, so that a surface counts
    by its area and not by how often it was seen.

    Raises:
        InputError: bad points, thresholds, voxel size or registration.
    """
    for threshold in (*thresholds_m, rcm_threshold_m):
        _check_threshold(threshold)
    cloud = voxel_downsample(check_points(points, "points"), voxel_m)
    true_cloud = voxel_downsample(check_points(truth, "truth"), voxel_m)
    # Distances matter only up to the largest threshold: a bounded search is much faster, and the
    # points beyond it stay at infinity.
    reach = max(*thresholds_m, rcm_threshold_m)
    true_tree = cKDTree(true_cloud, balanced_tree=False, compact_nodes=False)
    tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)
    to_truth = true_tree.query(cloud, distance_upper_bound=reach)[0]
    to_map = tree.query(true_cloud, distance_upper_bound=reach)[0]
    precisions = {t: float((to_truth < t).mean()) for t in thresholds_m}
    recalls = {t: float((to_map < t).mean()) for t in thresholds_m}
    return MapMetrics(
        precision=precisions,
        recall=recalls,
        f_score={t: harmonic_mean(precisions[t], recalls[t]) for t in thresholds_m},
        rer_m=_rms(_registered_distances(cloud, true_tree, registration)),
        rcm=float((to_map < rcm_threshold_m).mean()),
    )


def icp(source: ArrayLike, target: ArrayLike, cutoff_m: float = CUTOFF_M) -> Float64:
    """Rigid motion T_target_source (4, 4) by point-to-point iterative closest point.

    `register_clouds` tells more, and knows other methods.
    """
    return register_clouds(source, target, "icp", cutoff_m, ICP_POINTS).T_target_source


def _registered_distances(cloud: Float64, true_tree: cKDTree, registration: str) -> Float64:
    """Distances (N,) of the cloud to the truth, after registration to it."""
    found = register_clouds(cloud, np.asarray(true_tree.data), registration, max_points=ICP_POINTS)
    return true_tree.query(transform_points(found.T_target_source, cloud))[0]


def _rms(distances: Float64) -> float:
    return float(np.sqrt(np.mean(distances**2)))


def harmonic_mean(a: float, b: float) -> float:
    """2 a b / (a + b), 0 where both are 0."""
    return 2 * a * b / (a + b) if a + b > 0 else 0.0


def _check_threshold(threshold_m: float) -> None:
    if not (np.isfinite(threshold_m) and threshold_m > 0):
        raise InputError(f"a threshold must be finite and > 0 m, got {threshold_m}")
