"""The Gymnasium environments."""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv
    from ms_slam_env.env.env_config import EnvConfig, LookaheadConfig
    from ms_slam_env.env.episode import Episode
    from ms_slam_env.env.planners import Planner, PrivilegedPlanner
    from ms_slam_env.env.reward import RewardConfig, TargetConfig
    from ms_slam_env.env.robot_knowledge import STATE_NAMES
    from ms_slam_env.env.robot_view import PrivilegedView, RobotView
else:
    __getattr__ = lazy_names(__name__)

__all__ = [
    "STATE_NAMES",
    "ActiveSlamEnv",
    "EnvConfig",
    "Episode",
    "LookaheadConfig",
    "Planner",
    "PrivilegedPlanner",
    "PrivilegedView",
    "RewardConfig",
    "RobotView",
    "TargetConfig",
]
