"""RGB-D odometry against keyframes: what SLAM is measured against."""

from ms_slam_env.slam.odometry.odometry import OdometryConfig, OdometrySlam

__all__ = ["OdometryConfig", "OdometrySlam"]
