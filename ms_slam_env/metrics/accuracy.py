"""Accuracy, completion and completion ratio, as the papers on dense reconstruction state them.

Source: Sucar, Liu, Ortiz, Davison, "iMAP: implicit mapping and positioning in real-time", ICCV
2021, section 4, and Zhu et al., "NICE-SLAM", CVPR 2022, which take 200,000 points evenly from the
surface of either mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.reconstruction import nearest_distances

Float64 = NDArray[np.float64]

SAMPLES = 200_000
RATIO_THRESHOLD_M = 0.05


@dataclass(frozen=True)
class Completion:
    """How near a reconstruction is to the truth, and how much of that it has.

    Attributes:
        accuracy_cm: mean distance of points of the reconstruction to the truth.
        completion_cm: mean distance of true points to the reconstruction.
        completion_ratio: share of the true points nearer than the threshold to it; the papers
            print it in per cent, at 5 cm.
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
    if not threshold_m > 0:
        raise InputError(f"a threshold must be > 0 m, got {threshold_m}")
    return completion_of(
        nearest_distances(points, truth), nearest_distances(truth, points), threshold_m
    )


def completion_of(to_truth: Float64, to_map: Float64, threshold_m: float) -> Completion:
    """The same from distances (N,) of points to the truth and (M,) of the truth to points."""
    return Completion(
        accuracy_cm=100 * float(to_truth.mean()),
        completion_cm=100 * float(to_map.mean()),
        completion_ratio=float((to_map < threshold_m).mean()),
    )
