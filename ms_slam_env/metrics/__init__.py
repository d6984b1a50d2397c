"""Errors of trajectories and maps; costs of SLAM."""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.geometry.cloud_registration import CloudRegistration, register_clouds
    from ms_slam_env.geometry.point_clouds import umeyama, voxel_downsample
    from ms_slam_env.metrics.cost import (
        CORE_WATTS,
        CostMeter,
        EnergyCounter,
        FrameCost,
        energy_counters,
    )
    from ms_slam_env.metrics.multi_robot import (
        inter_robot_errors,
        inter_robot_rpe,
        mean_path_length,
        task_time,
        team_ate,
        team_rpe,
    )
    from ms_slam_env.metrics.reconstruction import (
        CloudDistance,
        Completion,
        cloud_distance,
        completion,
        f_score,
        hausdorff_distance,
        icp,
        nearest_distances,
        noise_ratio,
        point_spacing,
        precision,
        rcm,
        recall,
        rer,
        statistical_inliers,
    )
    from ms_slam_env.metrics.relative import (
        Drift,
        drifts,
        equal_pieces,
        pose_pairs,
        relative_errors,
        rpe_rmse,
        rpe_statistics,
    )
    from ms_slam_env.metrics.robustness import (
        Initialisation,
        Relocalisation,
        TrackingRobustness,
        initialisation,
        local_scales,
        mean_relocalisation_time,
        relocalisation,
        relocalisation_times,
        tracked_segments,
        tracking_robustness,
    )
    from ms_slam_env.metrics.trajectory import (
        Alignment,
        ErrorStatistics,
        absolute_errors,
        ate_rmse,
        ate_statistics,
        find_alignment,
        path_length,
        statistics_of,
        tracked_errors,
    )
else:
    __getattr__ = lazy_names(__name__)

__all__ = [
    "CORE_WATTS",
    "Alignment",
    "CloudDistance",
    "CloudRegistration",
    "Completion",
    "CostMeter",
    "Drift",
    "EnergyCounter",
    "ErrorStatistics",
    "FrameCost",
    "Initialisation",
    "Relocalisation",
    "TrackingRobustness",
    "absolute_errors",
    "ate_rmse",
    "ate_statistics",
    "cloud_distance",
    "completion",
    "drifts",
    "energy_counters",
    "equal_pieces",
    "f_score",
    "find_alignment",
    "hausdorff_distance",
    "icp",
    "initialisation",
    "inter_robot_errors",
    "inter_robot_rpe",
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
    "relocalisation",
    "relocalisation_times",
    "rer",
    "rpe_rmse",
    "rpe_statistics",
    "statistical_inliers",
    "statistics_of",
    "task_time",
    "team_ate",
    "team_rpe",
    "tracked_errors",
    "tracked_segments",
    "tracking_robustness",
    "umeyama",
    "voxel_downsample",
]
