"""Dense SLAM with surfels, frame to model (Whelan et al., ElasticFusion, RSS 2015, IJRR 2016)."""

from ms_slam_env.slam.surfel.backend import SurfelSlam
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

__all__ = ["BatchedSurfelSlam", "SurfelConfig", "SurfelSlam"]
