"""Errors of maps: precision, recall, F-score, reconstruction error (RER), completeness, distances.

Clouds are compared as given; register them first (`register_clouds`) if needed. Sources besides
those named below: Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation",
Navigation Positioning and Timing 2021, section 1.2; for accuracy and completion Sucar, Liu, Ortiz,
Davison, "iMAP", ICCV 2021, section 4, and Zhu et al., "NICE-SLAM", CVPR 2022, which sample 200,000
points evenly from the surface of each mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.cloud_registration import CUTOFF_M, register_clouds
from ms_slam_env.geometry.point_clouds import IndexedCloud, check_points, indexed
from ms_slam_env.metrics.trajectory import check_count, check_positive

ICP_POINTS = 5000  # evenly picked points of a map, enough to register it


def nearest_distances(points: ArrayLike, truth: ArrayLike | IndexedCloud) -> Float64:
    """Distance (N,) in metres from each point (N, 3) to the nearest of ``truth`` (M, 3)."""
    return indexed(truth, "truth").tree.query(check_points(points, "points"))[0]


def precision(points: ArrayLike, truth: ArrayLike, threshold_m: float) -> float:
    """Share of ``points`` (N, 3) closer than ``threshold_m`` to ``truth`` (M, 3)."""
    check_positive(threshold_m, "a threshold", "m")
    return float((nearest_distances(points, truth) < threshold_m).mean())


def recall(points: ArrayLike, truth: ArrayLike, threshold_m: float) -> float:
    """Share of ``truth`` (M, 3) closer than ``threshold_m`` to ``points`` (N, 3)."""
    return precision(truth, points, threshold_m)


def rcm(points: ArrayLike, truth: ArrayLike, threshold_m: float = 0.05) -> float:
    """Reconstruction completeness: share of the true points that the map covers, i.e. `recall`.

    Saeedi et al., ICRA 2017, section II-A: "the reconstructed percentage of the ground truth
    points".
    """
    return recall(points, truth, threshold_m)


def f_score(points: ArrayLike, truth: ArrayLike, threshold_m: float) -> float:
    """Harmonic mean of `precision` and `recall` (Knapitsch et al., Tanks and Temples, 2017)."""
    return harmonic_mean(precision(points, truth, threshold_m), recall(points, truth, threshold_m))


def rer(points: ArrayLike, truth: ArrayLike | IndexedCloud, registration: str = "icp") -> float:
    """Reconstruction error: RMS distance in metres of map points to the nearest true point.

    Saeedi et al., ICRA 2017, section II-A: "determined by running iterative closest point on the
    point cloud models of the world and the map. The error of the point cloud matching is used as
    RER". ``registration="none"`` leaves the map where its estimated poses put it; the other
    methods are those of `register_clouds`.

    Raises:
        InputError: bad points or an unknown registration.
    """
    cloud, true_cloud = check_points(points, "points"), indexed(truth, "truth")
    found = register_clouds(cloud, true_cloud, registration, max_points=ICP_POINTS)
    distances = nearest_distances(transform_points(found.T_target_source, cloud), true_cloud)
    return float(np.sqrt(np.mean(distances**2)))


def icp(source: ArrayLike, target: ArrayLike, cutoff_m: float = CUTOFF_M) -> Float64:
    """Rigid motion T_target_source (4, 4) by point-to-point iterative closest point.

    `register_clouds` returns more details and offers other methods.
    """
    return register_clouds(source, target, "icp", cutoff_m, ICP_POINTS).T_target_source


def harmonic_mean(a: float, b: float) -> float:
    """2 a b / (a + b), or 0 if both are 0."""
    return 2 * a * b / (a + b) if a + b > 0 else 0.0


SAMPLES = 200_000
RATIO_THRESHOLD_M = 0.05


@dataclass(frozen=True)
class Completion:
    """Accuracy and completeness of a reconstruction.

    Attributes:
        accuracy_cm: mean distance from points of the reconstruction to the truth.
        completion_cm: mean distance from true points to the reconstruction.
        completion_ratio: share of the true points closer to the reconstruction than the
            threshold; the papers print it in per cent, at 5 cm.
    """

    accuracy_cm: float
    completion_cm: float
    completion_ratio: float


def completion(
    points: ArrayLike, truth: ArrayLike, threshold_m: float = RATIO_THRESHOLD_M
) -> Completion:
    """Accuracy and completion of ``points`` (N, 3) against ``truth`` (M, 3), metres.

    Raises:
        InputError: bad points, or a threshold that is not positive.
    """
    check_positive(threshold_m, "a threshold", "m")
    to_truth, to_map = nearest_distances(points, truth), nearest_distances(truth, points)
    return Completion(
        accuracy_cm=100 * float(to_truth.mean()),
        completion_cm=100 * float(to_map.mean()),
        completion_ratio=float((to_map < threshold_m).mean()),
    )


@dataclass(frozen=True)
class CloudDistance:
    """Statistics of the distances from one cloud's points to another cloud (C2C), metres.

    Attributes:
        mean: mean over the points.
        std: standard deviation.
        rms: root mean square.
        max: largest, the directed Hausdorff distance.
    """

    mean: float
    std: float
    rms: float
    max: float


def statistical_inliers(
    points: ArrayLike, neighbours: int = 20, std_ratio: float = 2.0, two_sided: bool = False
) -> NDArray[np.bool_]:
    """Mask (N,) bool of the ``points`` (N, 3) that statistical outlier removal keeps.

    USME, section 1.2 (1), after Rusu et al., "Towards 3D point cloud based object maps", 2008: the
    mean distance d of a point to its ``neighbours`` nearest points, including itself, must be
    below mean(d) + ``std_ratio`` std(d) over the cloud. A point that coincides with all its
    neighbours is dropped too, as in Open3D. USME drops points outside mean(d) +- alpha std(d), so
    also points that are too close together; ``two_sided`` does that.

    Raises:
        InputError: bad points, fewer than 2 neighbours, fewer points than neighbours, or a ratio
            that is not positive.
    """
    from scipy.spatial import cKDTree

    values = check_points(points, "points")
    check_count(neighbours, "neighbours", least=2)
    if len(values) < neighbours:
        raise InputError(f"{neighbours} neighbours need as many points, got {len(values)}")
    check_positive(std_ratio, "std_ratio")
    mean = cKDTree(values).query(values, k=neighbours)[0].mean(axis=1)
    middle, reach = mean.mean(), std_ratio * mean.std(ddof=1)
    kept = (mean > 0) & (mean < middle + reach)
    return kept & (mean > middle - reach) if two_sided else kept


NOISE_SIGMAS = 3.0
"""A point this many standard deviations off the surface is noise: 0.3 % of Gaussian errors are."""
NOISE_SIGMA_M = 0.01
"""Depth noise of a Kinect at 2.5 m (Nguyen et al. 2012), for maps whose sensor is not known."""


def noise_distance(truth: ArrayLike | IndexedCloud, sigma_m: float = NOISE_SIGMA_M) -> float:
    """Distance in metres from ``truth`` (M, 3) beyond which a map point is noise.

    ``NOISE_SIGMAS`` times the deviation expected of a right point: the sensor's depth noise
    ``sigma_m`` and, as ``truth`` consists of samples, their `point_spacing`. It must not be
    estimated from the map: a threshold that grows with the noise finds the same share in any map.

    Raises:
        InputError: bad points, fewer than 2, or a negative ``sigma_m``.
    """
    if not (np.isfinite(sigma_m) and sigma_m >= 0):
        raise InputError(f"sigma_m must be finite and >= 0 m, got {sigma_m!r}")
    return NOISE_SIGMAS * float(np.hypot(sigma_m, point_spacing(truth)))


def noise_ratio(
    points: ArrayLike, truth: ArrayLike | IndexedCloud, sigma_m: float = NOISE_SIGMA_M
) -> float:
    """Share of ``points`` (N, 3) farther than `noise_distance` from ``truth`` (M, 3).

    USME equation (8), N_n / N_c: USME removes irrelevant points by eye and counts them; here those
    that lie off the true surface are irrelevant. Without a true surface there is no such share: the
    points that a filter drops from a cloud say nothing of its noise, as the filter's threshold
    grows with it.
    """
    true_cloud = indexed(truth, "truth")
    beyond = nearest_distances(points, true_cloud) > noise_distance(true_cloud, sigma_m)
    return float(beyond.mean())


def point_spacing(points: ArrayLike | IndexedCloud) -> float:
    """Mean distance in metres from a point (N, 3) to its nearest neighbour: how sparse a cloud is.

    USME uses the number of points for this, which grows with the mapped area.

    Raises:
        InputError: bad points, or fewer than 2.
    """
    cloud = indexed(points, "points")
    if len(cloud) < 2:
        raise InputError("the spacing of points needs at least 2")
    return float(cloud.tree.query(cloud.points, k=2)[0][:, 1].mean())


def cloud_distance(points: ArrayLike, truth: ArrayLike) -> CloudDistance:
    """Cloud-to-cloud distance from each of ``points`` (N, 3) to the nearest of ``truth`` (M, 3)."""
    distances = nearest_distances(points, truth)
    return CloudDistance(
        mean=float(distances.mean()),
        std=float(distances.std()),
        rms=float(np.sqrt(np.mean(distances**2))),
        max=float(distances.max()),
    )


def hausdorff_distance(points: ArrayLike, truth: ArrayLike, symmetric: bool = True) -> float:
    """Hausdorff distance in metres of clouds (N, 3) and (M, 3), USME equation (7).

    The directed distance, which USME describes, is the maximum over a in ``points`` of the minimum
    over b in ``truth`` of |a - b|; it ignores surface that ``points`` lacks. The symmetric distance
    is the larger of both directions.
    """
    there = cloud_distance(points, truth).max
    return max(there, cloud_distance(truth, points).max) if symmetric else there
