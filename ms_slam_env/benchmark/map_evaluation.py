"""Two map files compared: a reconstruction against the true surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics
from ms_slam_env.benchmark.surface_files import read_surface
from ms_slam_env.config import check_choice, check_range
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.cloud_registration import CUTOFF_M, REGISTRATIONS
from ms_slam_env.metrics.accuracy import SAMPLES

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class MapOptions:
    """How two maps are compared.

    Attributes:
        register: how the map is first brought onto the truth: ``none``, ``icp``, ``plane-icp`` or
            ``gicp``.
        cutoff_m: pairs of points farther apart do not count in that.
        remove_outliers: statistically, before everything else, as USME does.
        neighbours: of a point in the statistics of outliers.
        std_ratio: standard deviations above the mean that make an outlier.
        thresholds_m: for precision, recall and F-score.
        voxel_m: both clouds keep one point a voxel of this side, so that a surface counts by its
            area; 0 keeps all.
        samples: points taken from a mesh.
        seed: of that choice.
    """

    register: str = "none"
    cutoff_m: float = CUTOFF_M
    remove_outliers: bool = False
    neighbours: int = 20
    std_ratio: float = 2.0
    thresholds_m: Sequence[float] = (0.02, 0.05)
    voxel_m: float = 0.01
    samples: int = SAMPLES
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        check_choice(self, "register", REGISTRATIONS)
        check_range(self, "cutoff_m", 1e-6, 1e6)
        check_range(self, "neighbours", 2, 10_000)
        check_range(self, "std_ratio", 1e-6, 1e6)
        check_range(self, "voxel_m", 0.0, 1e3)
        check_range(self, "samples", 1, 100_000_000)
        check_range(self, "seed", 0, 2**32 - 1)
        if len(self.thresholds_m) == 0:
            raise InputError("MapOptions.thresholds_m is empty")
        for threshold in self.thresholds_m:
            if not 0 < threshold <= 1e6:
                raise InputError(f"MapOptions.thresholds_m = {threshold} is outside (0, 1e+06]")


@dataclass(frozen=True)
class ComparedMaps:
    """What a figure needs.

    Attributes:
        points: (N, 3) of the map, where it was judged.
        truth: (M, 3).
        quality: of the map.
    """

    points: Float64
    truth: Float64
    quality: metrics.MapQuality


def evaluate_maps(
    estimate: Path, truth: Path, options: MapOptions | None = None
) -> tuple[dict[str, Any], ComparedMaps]:
    """Compare the map in file ``estimate`` with the true surface in file ``truth``.

    Returns:
        The measures by flat names, lengths in metres unless the name says otherwise, and the clouds
        that they are of. ``rer_m`` is taken after point-to-point ICP if nothing else was asked for.

    Raises:
        InputError: a file that cannot be read, too few points for the statistics of outliers.
    """
    options = options or MapOptions()
    read = read_surface(estimate, options.samples, options.seed)
    true = read_surface(truth, options.samples, options.seed)
    inliers = metrics.statistical_inliers(read.points, options.neighbours, options.std_ratio)
    kept = read.points[inliers] if options.remove_outliers else read.points
    if len(kept) == 0:
        raise InputError(f"statistical outlier removal leaves nothing of {estimate}")
    points, surface = (_thin(cloud, options.voxel_m) for cloud in (kept, true.points))
    found = metrics.register_clouds(points, surface, options.register, options.cutoff_m)
    points = transform_points(found.T_target_source, points)
    quality = metrics.map_quality(points, surface, options.thresholds_m)
    unregistered = options.register == "none"
    by_threshold = {}
    for threshold in options.thresholds_m:
        name = f"{100 * threshold:g}cm"
        by_threshold[f"precision_{name}"] = quality.precision[threshold]
        by_threshold[f"recall_{name}"] = quality.recall[threshold]
        by_threshold[f"f_{name}"] = quality.f_score[threshold]
    result = {
        "map": str(estimate),
        "true_map": str(truth),
        "map_kind": read.kind,
        "true_map_kind": true.kind,
        **asdict(options),
        "map_points": len(read.points),
        "true_points": len(true.points),
        "compared_points": len(points),
        "compared_true_points": len(surface),
        "noise_ratio": 1.0 - float(inliers.mean()),
        "spacing_m": metrics.point_spacing(read.points),
        **by_threshold,
        "accuracy_cm": quality.completion.accuracy_cm,
        "completion_cm": quality.completion.completion_cm,
        "completion_ratio": quality.completion.completion_ratio,
        "rcm": quality.completion.completion_ratio,
        "rer_m": metrics.rer(points, surface) if unregistered else quality.distance.rms,
        "c2c_mean_m": quality.distance.mean,
        "c2c_std_m": quality.distance.std,
        "c2c_rms_m": quality.distance.rms,
        "hausdorff_directed_m": quality.distance.max,
        "hausdorff_m": quality.hausdorff_m,
        "registration_converged": None if unregistered else found.converged,
        "registration_share": None if unregistered else found.share,
        "T_true_map": found.T_target_source.tolist(),
    }
    return result, ComparedMaps(points, surface, quality)


def _thin(points: Float64, voxel_m: float) -> Float64:
    return metrics.voxel_downsample(points, voxel_m) if voxel_m > 0 else points
