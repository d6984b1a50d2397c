"""RGB-D sequences with known poses, rendered in a scene."""

from __future__ import annotations

import collections.abc
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import FRAME_RATE_HZ, NoiseConfig
from ms_slam_env.sequences.perturbations.base import Perturbation
from ms_slam_env.sequences.pose_interpolation import PoseInterpolation
from ms_slam_env.sequences.rendering import RenderedFrames


@dataclass(frozen=True)
class Sequence:
    """Frames and the poses they were taken from.

    Iterating gives pairs (frame, T_world_camera (4, 4)).

    Attributes:
        frames: N frames; those of a rendered sequence are rendered when they are asked for, each
            time anew and always the same. ``tuple(sequence.frames)`` holds them all.
        poses: (N, 4, 4) float64 true T_world_camera.
        intrinsics: of all frames.
        name: for tables and files.

    Raises:
        InputError: numbers of frames and poses that differ.
    """

    frames: collections.abc.Sequence[RGBDFrame]
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

    def __iter__(self) -> Iterator[tuple[RGBDFrame, NDArray[np.float64]]]:
        """Iterate over frames and their true poses."""
        return zip(self.frames, self.poses, strict=True)


@dataclass(frozen=True)
class RenderedSequence(Sequence):
    """A sequence whose frames are rendered when they are asked for.

    Attributes:
        frames: the renderer; ``frames.truth(index)`` is the noise-free view from a frame's pose,
            ``frames.kept`` (N,) the frames' indices on the trajectory, ``frames.timestamps`` (N,).
    """

    frames: RenderedFrames


def render_sequence(
    scene: Scene,
    trajectory: ArrayLike,
    intrinsics: Intrinsics,
    noise: str | NoiseConfig = "kinect",
    seed: int = 0,
    name: str | None = None,
    *,
    perturbations: Iterable[Perturbation] = (),
    timestamps: ArrayLike | None = None,
) -> RenderedSequence:
    """Take one frame from every pose of a trajectory, less those that a perturbation skips.

    Args:
        scene: where.
        trajectory: (N, 4, 4) T_world_camera, of the depth camera.
        intrinsics: of the frames.
        noise: of the sensor: "kinect", "none" or a NoiseConfig.
        seed: of the noise and the perturbations: with the same arguments every frame is the same,
            bit for bit, in whatever order they are rendered.
        name: for tables and files.
        perturbations: applied in this order; first those that select frames, then those of the
            optics, then those of the images.
        timestamps: (N,) seconds; index / 30 Hz by default.

    Raises:
        InputError: a bad pose, time or seed, an unknown noise model, or no perturbation.
    """
    poses = np.asarray(trajectory, dtype=np.float64)
    times = np.arange(len(poses)) / FRAME_RATE_HZ if timestamps is None else timestamps
    path = PoseInterpolation(times, poses)
    frames = RenderedFrames(scene, path, intrinsics, noise, seed, perturbations)
    return RenderedSequence(frames, frames.poses, intrinsics, name or f"{scene.name}-{scene.seed}")
