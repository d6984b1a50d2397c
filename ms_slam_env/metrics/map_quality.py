"""All measures of a map's points against the true surface, from one search in each direction.

Sources: Qu, Zhang, Yang, Dong, "USME", Navigation Positioning and Timing 2021, section 1.2 and
equation (7); Knapitsch et al., "Tanks and Temples", 2017; Sucar et al., "iMAP", ICCV 2021; Saeedi
et al., ICRA 2017, section II-A.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.accuracy import RATIO_THRESHOLD_M, Completion, completion_of
from ms_slam_env.metrics.cloud import CloudDistance, distance_statistics
from ms_slam_env.metrics.reconstruction import harmonic_mean, nearest_distances

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class MapQuality:
    """A map where it lies, against the truth.

    Attributes:
        to_truth: (N,) distance in metres of each map point to the true surface.
        to_map: (M,) distance of each true point to the map.
        distance: cloud-to-cloud distance (C2C) of the map to the truth; its ``rms`` is RER where
            the map has been registered, its ``max`` the directed Hausdorff distance.
        hausdorff_m: Hausdorff distance, both directions, USME equation (7).
        precision: threshold in metres -> share of map points that near the truth.
        recall: threshold -> share of true points that near the map (RCM at that threshold).
        f_score: threshold -> harmonic mean of both.
        completion: accuracy and completion in centimetres, completion ratio at 5 cm.
    """

    to_truth: Float64
    to_map: Float64
    distance: CloudDistance
    hausdorff_m: float
    precision: dict[float, float]
    recall: dict[float, float]
    f_score: dict[float, float]
    completion: Completion


def map_quality(
    points: ArrayLike, truth: ArrayLike, thresholds_m: Sequence[float] = (0.02, 0.05)
) -> MapQuality:
    """Judge ``points`` (N, 3) of a map against points (M, 3) of the true surface, metres.

    Every point counts alike: thin both clouds first (`voxel_downsample`) for a surface to count by
    area.

    Raises:
        InputError: bad points, no threshold, or one that is not finite and positive.
    """
    if len(thresholds_m) == 0 or not all(np.isfinite(t) and t > 0 for t in thresholds_m):
        raise InputError(f"thresholds must be finite and > 0 m, got {tuple(thresholds_m)}")
    to_truth, to_map = nearest_distances(points, truth), nearest_distances(truth, points)
    precision = {t: float((to_truth < t).mean()) for t in thresholds_m}
    recall = {t: float((to_map < t).mean()) for t in thresholds_m}
    return MapQuality(
        to_truth=to_truth,
        to_map=to_map,
        distance=distance_statistics(to_truth),
        hausdorff_m=float(max(to_truth.max(), to_map.max())),
        precision=precision,
        recall=recall,
        f_score={t: harmonic_mean(precision[t], recall[t]) for t in thresholds_m},
        completion=completion_of(to_truth, to_map, RATIO_THRESHOLD_M),
    )
