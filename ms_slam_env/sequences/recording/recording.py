"""A recorded sequence, read from disk frame by frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, parse_image_size
from ms_slam_env.camera.depth_registration import ColorCamera, Registration
from ms_slam_env.camera.frame import reduce_color, reduce_depth
from ms_slam_env.camera.image_files import read_color, read_depth
from ms_slam_env.camera.image_size import Crop
from ms_slam_env.camera.undistortion import undistort_color, undistort_depth
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.sequence import Frames, Sequence
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S, associate

SATURATED = 65535
"""Largest value of a 16-bit depth image, which many sensors write for no reading."""


@dataclass(frozen=True)
class Entry:
    """One frame: its time, its files, and where it is listed (``file:line``).

    Attributes:
        timestamp: seconds.
        depth: path of the depth image.
        color: path of the colour image; None if the recording has no colour.
        where: origin for error messages.
    """

    timestamp: float
    depth: Path
    color: Path | None
    where: str

    def read(
        self, camera: Intrinsics, color_camera: Intrinsics | None = None
    ) -> tuple[NDArray[np.uint8] | None, NDArray[Any]]:
        """Read colour (H, W, 3), if there is any, and depth values (H, W), as they are on disk.

        Both have the size of ``camera``; if given, ``color_camera`` has that of colour.

        Raises:
            InputError: a file is missing, truncated, or of another kind or size; the message names
                it.
        """
        depth = read_depth(self.depth, camera)
        color = None if self.color is None else read_color(self.color, color_camera or camera)
        return color, depth


@dataclass(frozen=True)
class Recording(Frames):
    """Recorded frames in order of time; each is decoded on request.

    Attributes:
        name: name for tables and files.
        layout: name of the folder layout it was read with.
        entries: N frames.
        source: intrinsics of the images on disk, possibly distorted; returned frames are not.
        intrinsics: intrinsics of the returned frames.
        depth_scale: depth image value per metre.
        truth_times: (M,) seconds, or None.
        truth: (M, 4, 4) true T_world_camera, or None.
        registration: pose of the colour camera, known or assumed to be a Kinect's; None if colour
            is already registered to depth.
        crop: the part of the images on disk to use; None for whole images.

    Raises:
        InputError: no frame, or times that do not increase.
    """

    name: str
    layout: str
    entries: tuple[Entry, ...]
    source: Intrinsics
    intrinsics: Intrinsics
    depth_scale: float
    truth_times: Float64 | None = None
    truth: Float64 | None = None
    registration: Registration | ColorCamera | None = None
    crop: Crop | None = None

    def __post_init__(self) -> None:
        """Refuse invalid frames and times."""
        if not self.entries:
            raise InputError(f"sequence {self.name} holds no frame")
        for before, entry in zip(self.entries, self.entries[1:], strict=False):
            if not entry.timestamp > before.timestamp:
                raise InputError(
                    f"{entry.where}: timestamp {entry.timestamp} does not come after "
                    f"{before.timestamp}"
                )

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.entries)

    @property
    def timestamps(self) -> Float64:
        """(N,) seconds."""
        return np.array([entry.timestamp for entry in self.entries])

    @property
    def has_color(self) -> bool:
        """Whether every frame has a colour image."""
        return all(entry.color is not None for entry in self.entries)

    def at_size(self, size: str) -> Recording:
        """Return the same recording with its frames resampled to ``size``, such as ``320x240``.

        Args:
            size: see `ms_slam_env.camera.image_size`; ``160x120+crop`` takes the largest central
                part with that aspect ratio.

        Raises:
            InputError: an unknown size, or one to which the images on disk cannot be reduced.
        """
        named = parse_image_size(size)
        crop = named.part_of(self.source, f"sequence {self.name}")
        part = self.source.undistorted.cropped(*dataclasses.astuple(crop))
        intrinsics = part if named.size is None else part.resized(*named.size)
        return dataclasses.replace(self, intrinsics=intrinsics, crop=crop)

    def every(self, n: int) -> Recording:
        """Return the same recording with every ``n``-th frame, starting with the first."""
        return dataclasses.replace(self, entries=self.entries[::n])

    def picked(self, indices: NDArray[np.integer]) -> Recording:
        """Return the same recording with only the frames of these numbers (M,), increasing."""
        return dataclasses.replace(self, entries=tuple(self.entries[int(k)] for k in indices))

    def frame(self, index: int) -> RGBDFrame:
        """Decode frame ``index``: depth in metres, 0 = no reading; colour black if there is none.

        Raises:
            InputError: a file is missing, truncated, or of another kind or size; the message names
                it and the line that lists it.
        """
        entry = self.entries[index]
        known = self.registration if isinstance(self.registration, ColorCamera) else None
        try:
            read, raw = entry.read(self.source, None if known is None else known.intrinsics)
        except InputError as error:
            raise InputError(f"{entry.where}: {error}") from None
        depth: NDArray[Any] = raw.astype(np.float32) / np.float32(self.depth_scale)
        if raw.dtype.kind in "iu":
            depth[raw == SATURATED] = 0
        color: NDArray[Any] = np.zeros((*raw.shape, 3), np.uint8) if read is None else read
        if known is not None and read is not None:
            color, is_seen = known.register(read, depth, self.source)
            depth = np.where(is_seen, depth, np.float32(0))  # as in a registered image
        if self.source.distortion:
            color = undistort_color(color, self.source)
            depth = undistort_depth(depth, self.source)
        crop = self.crop or Crop(0, 0, self.source.width, self.source.height)
        rows = slice(crop.top, crop.top + crop.height)
        columns = slice(crop.left, crop.left + crop.width)
        color, depth = color[rows, columns], depth[rows, columns]
        size = (self.intrinsics.width, self.intrinsics.height)
        if size != (crop.width, crop.height):
            color = reduce_color(color, size)
            depth = reduce_depth(depth, size)
        if isinstance(self.registration, Registration) and entry.color is not None:
            factor = self.intrinsics.width / crop.width
            color = self.registration.register(color, depth, self.intrinsics, factor)
        return RGBDFrame(np.ascontiguousarray(color), np.ascontiguousarray(depth), entry.timestamp)


@dataclass(frozen=True)
class RecordedSequence(Sequence):
    """A sequence whose frames are decoded from disk on request.

    Attributes:
        frames: the recording, which contains the true trajectory at its own times.
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
        """The true pose (4, 4) nearest in time to the first frame, if near enough."""
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
        """Select the frames with these numbers (M,), increasing."""
        return recorded_sequence(self.frames.picked(indices))


def recorded_sequence(recording: Recording) -> RecordedSequence:
    """Make a sequence from a recording, with the true poses at the times of its frames."""
    poses = np.full((len(recording), 4, 4), np.nan)
    if recording.truth is not None and recording.truth_times is not None:
        own, true = associate(recording.timestamps, recording.truth_times, MAX_DIFFERENCE_S)
        poses[own] = recording.truth[true]
    return RecordedSequence(recording, poses, recording.intrinsics, recording.name)
