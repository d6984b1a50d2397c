"""Rigid motions: SO(3) and SE(3) maps, quaternions, pose checks."""

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry.pose import (
    MAX_COORDINATE_M,
    as_numbers,
    check_pose,
    invert,
    look_at,
    make_pose,
    orthonormal,
    pose_from_quaternion,
    quaternion_from_pose,
    relative_angle,
    transform_points,
)
from ms_slam_env.geometry.so3 import adjoint, hat, se3_exp, se3_log, so3_exp, so3_log

__all__ = [
    "MAX_COORDINATE_M",
    "Float64",
    "adjoint",
    "as_numbers",
    "check_pose",
    "hat",
    "invert",
    "look_at",
    "make_pose",
    "orthonormal",
    "pose_from_quaternion",
    "quaternion_from_pose",
    "relative_angle",
    "se3_exp",
    "se3_log",
    "so3_exp",
    "so3_log",
    "transform_points",
]
