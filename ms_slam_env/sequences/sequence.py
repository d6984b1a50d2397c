"""RGB-D sequences with what is known of their true poses: rendered in a scene, or recorded."""

from __future__ import annotations

import collections.abc
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import FRAME_RATE_HZ, NoiseConfig
from ms_slam_env.sequences.association import associate
from ms_slam_env.sequences.perturbations.base import Perturbation
from ms_slam_env.sequences.pose_interpolation import PoseInterpolation
from ms_slam_env.sequences.recording.listings import MAX_DIFFERENCE_S
from ms_slam_env.sequences.recording.recording import Recording
from ms_slam_env.sequences.rendering import RenderedFrames

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Sequence:
    """Frames and the poses they were taken from.

    Iterating gives pairs (frame, T_world_camera (4, 4)).

    Attributes:
        frames: N frames; those of a rendered or recorded sequence are rendered or decoded when they
            are asked for, each time anew and always the same. ``tuple(sequence.frames)`` holds
            them all.
        poses: (N, 4, 4) float64 true T_world_camera; NaN where it is not known.
        intrinsics: of all frames.
        name: for tables and files.

    Raises:
        InputError: numbers of frames and poses that differ.
    """

    frames: collections.abc.Sequence[RGBDFrame]
    poses: Float64
    intrinsics: Intrinsics
    name: str

    def __post_init__(self) -> None:
        """Refuse frames without pose."""
        if self.poses.shape != (len(self.frames), 4, 4):
            raise InputError(f"{len(self.frames)} frames but poses of shape {self.poses.shape}")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __iter__(self) -> Iterator[tuple[RGBDFrame, Float64]]:
        """Iterate over frames and their true poses."""
        return zip(self.frames, self.poses, strict=True)

    @property
    def timestamps(self) -> Float64:
        """(N,) seconds."""
        return np.array([frame.timestamp for frame in self.frames])

    @property
    def has_color(self) -> bool:
        """Whether the frames have colour; without it they are black."""
        return True

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) whether the true pose of a frame is known."""
        return np.asarray(np.isfinite(self.poses).all(axis=(1, 2)))

    @property
    def start(self) -> Float64 | None:
        """True pose (4, 4) of the first frame; None where it is not known."""
        return self.poses[0] if self.known[0] else None

    def true_trajectory(self) -> tuple[Float64, Float64] | None:
        """Times (M,) in seconds and true T_world_camera (M, 4, 4), as known; None without any."""
        known = self.known
        return (self.timestamps[known], self.poses[known]) if known.any() else None

    def true_depth(self, index: int) -> NDArray[np.float32]:
        """Depth (H, W) in metres of what frame ``index`` shows, as truly as it is known."""
        return self.frames[index].depth

    def picked(self, indices: NDArray[np.integer]) -> Sequence:
        """The same sequence with the frames of these numbers (M,) only, increasing."""
        frames = tuple(self.frames[int(index)] for index in indices)
        return replace(self, frames=frames, poses=self.poses[indices])

    def where_known(self) -> Sequence:
        """The same sequence without the frames whose true pose is not known.

        Raises:
            InputError: fewer than two are left.
        """
        known = self.known
        if not known.any():
            raise InputError(f"sequence {self.name} has no true trajectory to compare with")
        if known.sum() < 2:
            raise InputError(f"sequence {self.name}: fewer than 2 frames have a true pose")
        return self if known.all() else self.picked(np.flatnonzero(known))


@dataclass(frozen=True)
class RenderedSequence(Sequence):
    """A sequence whose frames are rendered when they are asked for.

    Attributes:
        frames: the renderer; ``frames.truth(index)`` is the noise-free view from a frame's pose,
            ``frames.kept`` (N,) the frames' indices on the trajectory, ``frames.timestamps`` (N,).
    """

    frames: RenderedFrames

    @property
    def timestamps(self) -> Float64:
        """(N,) seconds."""
        return self.frames.timestamps

    def true_depth(self, index: int) -> NDArray[np.float32]:
        """Noise-free depth (H, W) in metres from the true pose of frame ``index``."""
        return self.frames.truth(index).depth

    def picked(self, indices: NDArray[np.integer]) -> RenderedSequence:
        """The same sequence with the frames of these numbers (M,) only, increasing."""
        frames = self.frames.picked(indices)
        return replace(self, frames=frames, poses=frames.poses)


@dataclass(frozen=True)
class RecordedSequence(Sequence):
    """A sequence whose frames are decoded from disk when they are asked for.

    Attributes:
        frames: the recording, which has the true trajectory at its own times.
    """

    frames: Recording

    @property
    def timestamps(self) -> Float64:
        """(N,) seconds."""
        return self.frames.timestamps

    @property
    def has_color(self) -> bool:
        """Whether every frame has a colour image."""
        return self.frames.has_color

    @property
    def start(self) -> Float64 | None:
        """The true pose (4, 4) nearest in time to the first frame, if it is near."""
        trajectory = self.true_trajectory()
        if trajectory is None:
            return None
        times, poses = trajectory
        nearest = int(np.abs(times - self.timestamps[0]).argmin())
        is_near = abs(times[nearest] - self.timestamps[0]) <= MAX_DIFFERENCE_S
        return poses[nearest] if is_near else None

    def true_trajectory(self) -> tuple[Float64, Float64] | None:
        """Times (M,) in seconds and true T_world_camera (M, 4, 4), as recorded."""
        times, poses = self.frames.truth_times, self.frames.truth
        return None if times is None or poses is None else (times, poses)

    def picked(self, indices: NDArray[np.integer]) -> RecordedSequence:
        """The same sequence with the frames of these numbers (M,) only, increasing."""
        return recorded_sequence(self.frames.picked(indices))


def recorded_sequence(recording: Recording) -> RecordedSequence:
    """A recording with the true poses that were taken at the times of its frames."""
    poses = np.full((len(recording), 4, 4), np.nan)
    if recording.truth is not None and recording.truth_times is not None:
        own, true = associate(recording.timestamps, recording.truth_times, MAX_DIFFERENCE_S)
        poses[own] = recording.truth[true]
    return RecordedSequence(recording, poses, recording.intrinsics, recording.name)


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
