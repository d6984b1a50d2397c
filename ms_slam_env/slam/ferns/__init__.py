"""Keyframes found again by randomised ferns: for relocalisation and global loop closure."""

from ms_slam_env.slam.ferns.config import FernConfig
from ms_slam_env.slam.ferns.database import Candidate, FernDatabase
from ms_slam_env.slam.ferns.encoding import FernCode, FernEncoder, dissimilarities

__all__ = [
    "Candidate",
    "FernCode",
    "FernConfig",
    "FernDatabase",
    "FernEncoder",
    "dissimilarities",
]
