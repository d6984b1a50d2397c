"""Errors of trajectories and maps; costs of SLAM."""

from ms_slam_env.geometry.cloud_registration import CloudRegistration, register_clouds
from ms_slam_env.geometry.point_clouds import umeyama, voxel_downsample
from ms_slam_env.metrics.absolute import (
    Alignment,
    absolute_errors,
    ate_rmse,
    ate_statistics,
    find_alignment,
)
from ms_slam_env.metrics.accuracy import Completion, completion
from ms_slam_env.metrics.cloud import (
    CloudDistance,
    cloud_distance,
    hausdorff_distance,
    noise_ratio,
    point_spacing,
    statistical_inliers,
)
from ms_slam_env.metrics.consistency import (
    ConsistencyRule,
    MapConsistency,
    ObjectConsistency,
    judge_consistency,
)
from ms_slam_env.metrics.cost import CostMeter, EnergyCounter, FrameCost, energy_counters
from ms_slam_env.metrics.initialisation import Initialisation, initialisation, local_scales
from ms_slam_env.metrics.multi_robot import mean_path_length, task_time, team_ate, team_rpe
from ms_slam_env.metrics.reconstruction import (
    f_score,
    icp,
    nearest_distances,
    precision,
    rcm,
    recall,
    rer,
)
from ms_slam_env.metrics.relative import (
    pose_pairs,
    relative_errors,
    rpe_rmse,
    rpe_statistics,
)
from ms_slam_env.metrics.relocalisation import mean_relocalisation_time, relocalisation_times
from ms_slam_env.metrics.robustness import (
    TrackingRobustness,
    tracked_segments,
    tracking_robustness,
)
from ms_slam_env.metrics.segments import Drift, drifts, equal_pieces
from ms_slam_env.metrics.sightings import (
    LabelledView,
    SightingRule,
    count_votes,
    distinct_placements,
)
from ms_slam_env.metrics.trajectory import ErrorStatistics, path_length, statistics_of

__all__ = [
    "Alignment",
    "CloudDistance",
    "CloudRegistration",
    "Completion",
    "ConsistencyRule",
    "CostMeter",
    "Drift",
    "EnergyCounter",
    "ErrorStatistics",
    "FrameCost",
    "Initialisation",
    "LabelledView",
    "MapConsistency",
    "ObjectConsistency",
    "SightingRule",
    "TrackingRobustness",
    "absolute_errors",
    "ate_rmse",
    "ate_statistics",
    "cloud_distance",
    "completion",
    "count_votes",
    "distinct_placements",
    "drifts",
    "energy_counters",
    "equal_pieces",
    "f_score",
    "find_alignment",
    "hausdorff_distance",
    "icp",
    "initialisation",
    "judge_consistency",
    "local_scales",
    "mean_path_length",
    "mean_relocalisation_time",
    "nearest_distances",
    "noise_ratio",
    "path_length",
    "point_spacing",
    "pose_pairs",
    "precision",
    "rcm",
    "recall",
    "register_clouds",
    "relative_errors",
    "relocalisation_times",
    "rer",
    "rpe_rmse",
    "rpe_statistics",
    "statistical_inliers",
    "statistics_of",
    "task_time",
    "team_ate",
    "team_rpe",
    "tracked_segments",
    "tracking_robustness",
    "umeyama",
    "voxel_downsample",
]
