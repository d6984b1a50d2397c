"""Poses to search from where the last one leads nowhere."""

from __future__ import annotations

import numpy as np

from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.slam.base import Float64

TURN_RAD = np.radians(8.0)
"""About twice the rotation from which OpenCV's odometry finds back at 160x120."""

_TURNS = np.stack(
    [
        make_pose(so3_exp(sign * TURN_RAD * np.eye(3)[axis]), np.zeros(3))
        for axis in (1, 0, 2)
        for sign in (1.0, -1.0)
    ]
)


def start_poses(T_world_camera: Float64, T_last_camera: Float64) -> Float64:
    """Poses (7, 4, 4) around the last good one ``T_world_camera`` (4, 4), in the order of trial.

    First the pose that the last motion ``T_last_camera`` leads to if it goes on, then pans, tilts
    and rolls of 8 degrees. A turn stands for a sideways step too: both shift the image.
    """
    motions = np.concatenate([T_last_camera[None], _TURNS])
    return np.asarray(T_world_camera @ motions, dtype=np.float64)
