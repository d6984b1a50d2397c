"""An arm that holds the camera: model, kinematics, planning, control and physics."""

from ms_slam_env.robot.arm.chain import Chain
from ms_slam_env.robot.arm.config import ArmConfig, ArmNoise
from ms_slam_env.robot.arm.model import ARM_MODELS, ArmModel, load_arm

__all__ = ["ARM_MODELS", "ArmConfig", "ArmModel", "ArmNoise", "Chain", "load_arm"]
