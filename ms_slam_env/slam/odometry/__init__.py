"""RGB-D odometry against keyframes: what SLAM is measured against."""

from ms_slam_env.slam.odometry.config import OdometryConfig
from ms_slam_env.slam.odometry.odometry_slam import OdometrySlam

__all__ = ["OdometryConfig", "OdometrySlam"]
