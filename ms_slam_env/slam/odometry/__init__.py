"""RGB-D keyframe odometry, the baseline for SLAM."""

from ms_slam_env.slam.odometry.odometry import OdometryConfig, OdometrySlam

__all__ = ["OdometryConfig", "OdometrySlam"]
