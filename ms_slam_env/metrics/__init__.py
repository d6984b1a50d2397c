"""Errors of trajectories and maps."""

from ms_slam_env.metrics.alignment import umeyama
from ms_slam_env.metrics.consistency import (
    ConsistencyRule,
    MapConsistency,
    ObjectConsistency,
    judge_consistency,
)
from ms_slam_env.metrics.reconstruction import (
    MapMetrics,
    f_score,
    icp,
    map_metrics,
    nearest_distances,
    precision,
    rcm,
    recall,
    rer,
    voxel_thin,
)
from ms_slam_env.metrics.relocalisation import mean_relocalisation_time, relocalisation_times
from ms_slam_env.metrics.sightings import (
    LabelledView,
    SightingRule,
    count_votes,
    distinct_placements,
)
from ms_slam_env.metrics.trajectory import (
    ErrorStatistics,
    absolute_errors,
    ate_rmse,
    ate_statistics,
    path_length,
    relative_errors,
    rpe_rmse,
    rpe_statistics,
)

__all__ = [
    "ConsistencyRule",
    "ErrorStatistics",
    "LabelledView",
    "MapConsistency",
    "MapMetrics",
    "ObjectConsistency",
    "SightingRule",
    "absolute_errors",
    "ate_rmse",
    "ate_statistics",
    "count_votes",
    "distinct_placements",
    "f_score",
    "icp",
    "judge_consistency",
    "map_metrics",
    "mean_relocalisation_time",
    "nearest_distances",
    "path_length",
    "precision",
    "rcm",
    "recall",
    "relative_errors",
    "relocalisation_times",
    "rer",
    "rpe_rmse",
    "rpe_statistics",
    "umeyama",
    "voxel_thin",
]
