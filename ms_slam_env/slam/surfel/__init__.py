"""Dense SLAM with surfels, frame to model (Whelan et al., ElasticFusion, RSS 2015, IJRR 2016)."""

from ms_slam_env.slam.surfel.backend import SurfelSlam
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam

__all__ = ["BatchedSurfelSlam", "SurfelConfig", "SurfelSlam"]
