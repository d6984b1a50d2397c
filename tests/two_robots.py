"""Two robots that have mapped the same corner of a room."""

from __future__ import annotations

import numpy as np

from ms_slam_env import slam
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, look_at
from ms_slam_env.sequences import render_sequence
from ms_slam_env.slam.team.relative_map_poses import RobotRun

K = xtion("160x120")


def path_past(
    target: np.ndarray, eye: np.ndarray, step: np.ndarray, frames: int = 10
) -> np.ndarray:
    return np.stack([look_at(eye + k * step, target) for k in range(frames)])


def run_robot(scene, truth: np.ndarray, seed: int) -> RobotRun:
    """A robot whose SLAM is told its poses, in the frame of its first camera."""
    backend = slam.make("surfel", K)
    backend.reset()
    frames = tuple(render_sequence(scene, truth, K, "kinect", seed).frames)
    estimates = invert(truth[0]) @ truth
    for frame, pose in zip(frames, estimates, strict=True):
        backend.fuse(frame, pose)
    return RobotRun(backend, frames, estimates, np.ones(len(frames), dtype=bool))


CORNER = np.array([-2.0, 1.5, 1.0])
TRUTHS = (
    path_past(CORNER, np.array([0.0, 0.2, 1.3]), np.array([0.0, 0.03, 0.0])),
    path_past(CORNER, np.array([0.1, 0.6, 1.4]), np.array([-0.03, 0.0, 0.01])),
)
