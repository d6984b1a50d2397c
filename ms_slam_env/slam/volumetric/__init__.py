"""Volumetric SLAM: a truncated signed distance function, tracked frame to model."""

from ms_slam_env.slam.volumetric.config import VolumetricConfig
from ms_slam_env.slam.volumetric.kinect_fusion import KinectFusionConfig, KinectFusionSlam
from ms_slam_env.slam.volumetric.volumetric_slam import VolumetricSlam

__all__ = ["KinectFusionConfig", "KinectFusionSlam", "VolumetricConfig", "VolumetricSlam"]
