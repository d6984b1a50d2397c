"""An arm that holds the camera: model, kinematics, planning, control and physics."""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.robot.arm.arm_config import ArmConfig, ArmNoise
    from ms_slam_env.robot.arm.chain import Chain
    from ms_slam_env.robot.arm.model import ARM_MODELS, ArmModel, load_arm
else:
    __getattr__ = lazy_names(__name__)

__all__ = ["ARM_MODELS", "ArmConfig", "ArmModel", "ArmNoise", "Chain", "load_arm"]
