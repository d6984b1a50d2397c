"""Point clouds as such: outliers, noise ratio, spacing, distances between clouds.

Source: Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation
Positioning and Timing 2021, section 1.2. Clouds are compared where they lie; register them first
(`register_clouds`) if that is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ms_slam_env.errors import InputError
from ms_slam_env.geometry.point_clouds import check_points
from ms_slam_env.metrics.reconstruction import nearest_distances

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class CloudDistance:
    """Distances of a cloud's points to another cloud (C2C), metres.

    Attributes:
        mean: over the points.
        std: of the distances.
        rms: root mean square.
        max: the directed Hausdorff distance.
    """

    mean: float
    std: float
    rms: float
    max: float


def statistical_inliers(
    points: ArrayLike, neighbours: int = 20, std_ratio: float = 2.0
) -> NDArray[np.bool_]:
    """Which of ``points`` (N, 3) a statistical outlier removal keeps, (N,) bool.

    USME, section 1.2 (1), after Rusu et al., "Towards 3D point cloud based object maps", 2008: the
    mean distance d of a point to its ``neighbours`` nearest points, itself among them, must be
    below mean(d) + ``std_ratio`` std(d) over the cloud. A point that coincides with all its
    neighbours is dropped too, as Open3D does.

    Raises:
        InputError: bad points, fewer than 2 neighbours or fewer points than neighbours, a ratio
            that is not positive.
    """
    values = check_points(points, "points")
    if isinstance(neighbours, bool) or not isinstance(neighbours, int) or neighbours < 2:
        raise InputError(f"neighbours must be an integer >= 2, got {neighbours!r}")
    if len(values) < neighbours:
        raise InputError(f"{neighbours} neighbours need as many points, got {len(values)}")
    if not (np.isfinite(std_ratio) and std_ratio > 0):
        raise InputError(f"std_ratio must be finite and > 0, got {std_ratio}")
    mean = cKDTree(values).query(values, k=neighbours)[0].mean(axis=1)
    limit = mean.mean() + std_ratio * mean.std(ddof=1)
    return (mean > 0) & (mean < limit)


def noise_ratio(points: ArrayLike, neighbours: int = 20, std_ratio: float = 2.0) -> float:
    """Share of ``points`` (N, 3) that `statistical_inliers` drops, USME equation (8): N_n / N_c.

    USME removes the irrelevant points by eye; here the filter does, so that a program can.
    """
    return 1.0 - float(statistical_inliers(points, neighbours, std_ratio).mean())


def point_spacing(points: ArrayLike) -> float:
    """Mean distance in metres of a point (N, 3) to its nearest other: how sparse a cloud is.

    USME takes the number of points for that, which grows with the area that was mapped.

    Raises:
        InputError: bad points, or fewer than 2.
    """
    values = check_points(points, "points")
    if len(values) < 2:
        raise InputError("the spacing of points needs at least 2")
    return float(cKDTree(values).query(values, k=2)[0][:, 1].mean())


def cloud_distance(points: ArrayLike, truth: ArrayLike) -> CloudDistance:
    """Cloud-to-cloud distance: of each of ``points`` (N, 3) to the nearest of ``truth`` (M, 3)."""
    return distance_statistics(nearest_distances(points, truth))


def distance_statistics(distances: Float64) -> CloudDistance:
    """Statistics of distances (N,), N >= 1."""
    return CloudDistance(
        mean=float(distances.mean()),
        std=float(distances.std()),
        rms=float(np.sqrt(np.mean(distances**2))),
        max=float(distances.max()),
    )


def hausdorff_distance(points: ArrayLike, truth: ArrayLike, symmetric: bool = True) -> float:
    """Hausdorff distance in metres of clouds (N, 3) and (M, 3), USME equation (7).

    Directed it is max over a in ``points`` of min over b in ``truth`` of |a - b|, which does not
    see what ``points`` lacks; symmetric it is the larger of both directions.
    """
    there = cloud_distance(points, truth).max
    return max(there, cloud_distance(truth, points).max) if symmetric else there
