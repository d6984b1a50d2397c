"""Loop closure of the surfel SLAM: recognise places seen before, and bend the map to fit."""

from ms_slam_env.slam.surfel.loops.base import LoopClosure, NoLoopClosure
from ms_slam_env.slam.surfel.loops.config import LoopConfig

__all__ = ["LoopClosure", "LoopConfig", "NoLoopClosure"]
