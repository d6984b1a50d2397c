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
from ms_slam_env.evaluation.map_quality import ComparedMap, share_keys
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.cloud_registration import CUTOFF_M, REGISTRATIONS
from ms_slam_env.metrics.accuracy import SAMPLES

Float64 = NDArray[np.float64]

MEASURES = (
    *("accuracy_cm", "completion_cm", "completion_ratio", "rer_m", "rcm"),
    *("c2c_mean_m", "c2c_std_m", "c2c_rms_m", "hausdorff_directed_m", "hausdorff_m"),
)


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


def evaluate_maps(
    estimate: Path, truth: Path, options: MapOptions | None = None
) -> tuple[dict[str, Any], ComparedMap]:
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
    unregistered = options.register == "none"
    compared = ComparedMap(points, surface, voxel_m=0, registered=not unregistered)
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
        **compared.measure((*share_keys(options.thresholds_m), *MEASURES)),
        "registration_converged": None if unregistered else found.converged,
        "registration_share": None if unregistered else found.share,
        "T_true_map": found.T_target_source.tolist(),
    }
    return result, compared


def _thin(points: Float64, voxel_m: float) -> Float64:
    return metrics.voxel_downsample(points, voxel_m) if voxel_m > 0 else points
