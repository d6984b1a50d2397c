"""Errors of maps: precision, recall, F-score, reconstruction error (RER), completeness (RCM)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.cloud_registration import CUTOFF_M, register_clouds
from ms_slam_env.geometry.point_clouds import check_points

Float64 = NDArray[np.float64]

ICP_POINTS = 5000  # of a map, evenly picked, are enough to place it


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
