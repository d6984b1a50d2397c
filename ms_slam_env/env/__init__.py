"""The Gymnasium environments."""

from ms_slam_env.env.active_slam import ActiveSlamEnv
from ms_slam_env.env.config import EnvConfig, LookaheadConfig, RewardConfig, TargetConfig
from ms_slam_env.env.episode import Episode
from ms_slam_env.env.observations import STATE_NAMES
from ms_slam_env.env.planners import Planner

__all__ = [
    "STATE_NAMES",
    "ActiveSlamEnv",
    "EnvConfig",
    "Episode",
    "LookaheadConfig",
    "Planner",
    "RewardConfig",
    "TargetConfig",
]
