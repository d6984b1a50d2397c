"""Volumetric SLAM: a truncated signed distance function with frame-to-model tracking."""

from ms_slam_env.slam.volumetric.kinect_fusion import KinectFusionConfig, KinectFusionSlam
from ms_slam_env.slam.volumetric.volumetric_slam import Open3DSlam, VolumetricSlam
from ms_slam_env.slam.volumetric.voxel_grid import Open3DConfig, VolumetricConfig

__all__ = [
    "KinectFusionConfig",
    "KinectFusionSlam",
    "Open3DConfig",
    "Open3DSlam",
    "VolumetricConfig",
    "VolumetricSlam",
]
