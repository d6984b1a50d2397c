"""A slow arc through the box scene: the poses of its frames, and a frame in the dark."""

import numpy as np

from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import look_at, make_pose, so3_exp

CAMERA = xtion("160x120")
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])


def arc(count: int) -> np.ndarray:
    """Poses (count, 4, 4): 1 cm and 0.5 degrees a frame."""
    poses = [START]
    for _ in range(count - 1):
        poses.append(poses[-1] @ make_pose(so3_exp([0, np.radians(-0.5), 0]), [0.01, 0, 0.002]))
    return np.stack(poses)


def black_frame() -> RGBDFrame:
    """A frame without a reading."""
    return RGBDFrame(np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32))
