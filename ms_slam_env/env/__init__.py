"""The Gymnasium environments."""

from ms_slam_env.env.active_slam import ActiveSlamEnv
from ms_slam_env.env.adaptive_env import AdaptiveSlamEnv
from ms_slam_env.env.config import EnvConfig, LookaheadConfig, RewardConfig, TargetConfig
from ms_slam_env.env.planner import Planner

__all__ = [
    "ActiveSlamEnv",
    "AdaptiveSlamEnv",
    "EnvConfig",
    "LookaheadConfig",
    "Planner",
    "RewardConfig",
    "TargetConfig",
]
