"""Sparse SLAM: ORB features, local bundle adjustment, a pose graph, a map of keyframe depth."""

from ms_slam_env.slam.sparse.sparse_config import SparseConfig
from ms_slam_env.slam.sparse.sparse_slam import SparseSlam

__all__ = ["SparseConfig", "SparseSlam"]
