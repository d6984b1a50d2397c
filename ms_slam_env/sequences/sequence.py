"""RGB-D sequences with known poses, rendered in a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import NoiseConfig, RGBDSensor


@dataclass(frozen=True)
class Sequence:
    """Frames and the poses they were taken from.

    Attributes:
        frames: N frames.
        poses: (N, 4, 4) float64 true T_world_camera.
        intrinsics: of all frames.
        name: for tables and files.

    Raises:
        InputError: numbers of frames and poses that differ.
    """

    frames: tuple[RGBDFrame, ...]
    poses: NDArray[np.float64]
    intrinsics: Intrinsics
    name: str

    def __post_init__(self) -> None:
        """Refuse frames without pose."""
        if self.poses.shape != (len(self.frames), 4, 4):
            raise InputError(f"{len(self.frames)} frames but poses of shape {self.poses.shape}")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)


def render_sequence(
    scene: Scene,
    trajectory: ArrayLike,
    intrinsics: Intrinsics,
    noise: str | NoiseConfig = "kinect",
    seed: int = 0,
    name: str | None = None,
) -> Sequence:
    """Take one frame from every pose of ``trajectory`` (N, 4, 4); ``seed`` is that of the noise.

    Raises:
        InputError: a bad pose or an unknown noise model.
    """
    poses = np.asarray(trajectory, dtype=np.float64)
    sensor = RGBDSensor(scene, intrinsics, noise=noise, seed=seed)
    frames = tuple(sensor.capture(T, index) for index, T in enumerate(poses))
    return Sequence(frames, poses, intrinsics, name or f"{scene.name}-{scene.seed}")
