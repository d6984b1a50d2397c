"""A recorded sequence, read from disk frame by frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, parse_image_size
from ms_slam_env.camera.frame import reduce_color, reduce_depth
from ms_slam_env.camera.image_files import read_color, read_depth
from ms_slam_env.camera.image_size import Crop
from ms_slam_env.camera.undistortion import undistort_color, undistort_depth
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import Float64
from ms_slam_env.sequences.sequence import Frames, Sequence
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S, associate


@dataclass(frozen=True)
class Registration(Checked):
    """Where the colour camera is, as seen from the depth camera; the axes of both are parallel.

    The defaults are those commonly given for a Kinect that nobody calibrated, as in 7-Scenes:
    focal length 525 px for colour (OpenNI's default) and 585 px for depth (the dataset's page),
    colour 2.5 cm to the right of depth.

    Attributes:
        focal_ratio: focal length of the colour camera over that of the depth camera.
        baseline_m: the colour camera stands so far along the depth camera's x.
        shift_x_px: the colour image lies so many pixels too far to the right, at the size on disk.
        shift_y_px: and so many too far down.
    """

    focal_ratio: float = bounded(525.0 / 585.0, 0.1, 10.0)
    baseline_m: float = bounded(0.025, -1.0, 1.0)
    shift_x_px: float = bounded(0.0, -1e4, 1e4)
    shift_y_px: float = bounded(0.0, -1e4, 1e4)

    def register(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        intrinsics: Intrinsics,
        factor: float = 1.0,
    ) -> NDArray[np.uint8]:
        """Colour image (H, W, 3) as the depth camera would see it.

        Every pixel takes the colour at the place where its point lies in the colour camera. A pixel
        without depth borrows that of the nearest reading; where there is none at all the offset
        of the cameras is neglected. What the colour camera does not see takes the colour of the
        image's border; what is hidden from it takes the colour of what hides it.

        Args:
            color: (H, W, 3) as recorded.
            depth: (H, W) metres, 0 = no reading.
            intrinsics: of the depth camera, at the size of the images.
            factor: this size over the size on disk.
        """
        K = intrinsics
        v, u = np.mgrid[: K.height, : K.width].astype(np.float32)
        parallax = self.focal_ratio * K.fx * self.baseline_m * _inverse_depth(depth)
        x = self.focal_ratio * (u - K.cx) + K.cx + factor * self.shift_x_px - parallax
        y = self.focal_ratio * (v - K.cy) + K.cy + factor * self.shift_y_px
        registered = cv2.remap(
            color,
            x.astype(np.float32),
            y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return registered.astype(np.uint8, copy=False)

    def __str__(self) -> str:
        """Return what is assumed, for a report."""
        return (
            f"colour brought into the depth camera: focal ratio {self.focal_ratio:.4g}, baseline "
            f"{100 * self.baseline_m:g} cm, shift {self.shift_x_px:g}, {self.shift_y_px:g} px"
        )


def _inverse_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 / depth (H, W), of the nearest reading where there is none; 0 without any reading."""
    is_read = depth > 0
    if not is_read.any():
        return np.zeros_like(depth)
    inverse = (1.0 / np.where(is_read, depth, 1)).astype(np.float32)
    if is_read.all():
        return inverse
    # Every pixel with a reading is a zero pixel with a label of its own.
    _, nearest = cv2.distanceTransformWithLabels(
        (~is_read).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    of_label[nearest[is_read]] = inverse[is_read]
    return of_label[nearest]


@dataclass(frozen=True)
class Entry:
    """One frame: when, in which files, and where the listing says so (``file:line``).

    Attributes:
        timestamp: seconds.
        depth: path of the depth image.
        color: path of the colour image; None where the recording has no colour.
        where: for error messages.
    """

    timestamp: float
    depth: Path
    color: Path | None
    where: str

    def read(self, camera: Intrinsics) -> tuple[NDArray[np.uint8] | None, NDArray[Any]]:
        """Colour (H, W, 3), if there is any, and values of depth (H, W), as they are on disk.

        Raises:
            InputError: a file that is missing, truncated, of another kind or size; the message
                names it.
        """
        depth = read_depth(self.depth, camera)
        return None if self.color is None else read_color(self.color, camera), depth


@dataclass(frozen=True)
class Recording(Frames):
    """Frames in order of time; each is decoded when it is asked for.

    Attributes:
        name: for tables and files.
        layout: name of the folder layout it was read with.
        entries: N frames.
        source: intrinsics of the images on disk, maybe of a camera with a lens, which frames have
            no more.
        intrinsics: intrinsics of the frames that are returned.
        depth_scale: value of a depth image for one metre.
        no_reading: value of a depth image, besides 0, that means no reading.
        truth_times: (M,) seconds, or None.
        truth: (M, 4, 4) true T_world_camera, or None.
        registration: where the colour camera is, if colour has to be brought into the depth
            camera; None where the recording has that done.
        crop: the part of the images on disk that is taken; None for all of them.

    Raises:
        InputError: no frame, or times that do not increase.
    """

    name: str
    layout: str
    entries: tuple[Entry, ...]
    source: Intrinsics
    intrinsics: Intrinsics
    depth_scale: float
    no_reading: int | None = None
    truth_times: Float64 | None = None
    truth: Float64 | None = None
    registration: Registration | None = None
    crop: Crop | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be a sequence."""
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
            size: as `ms_slam_env.camera.image_size` describes; ``160x120+crop`` takes the largest
                central part of that aspect.

        Raises:
            InputError: an unknown size, or one that the images on disk cannot be reduced to.
        """
        named = parse_image_size(size)
        crop = named.part_of(self.source, f"sequence {self.name}")
        part = self.source.undistorted.cropped(*dataclasses.astuple(crop))
        intrinsics = part if named.size is None else part.resized(*named.size)
        return dataclasses.replace(self, intrinsics=intrinsics, crop=crop)

    def every(self, n: int) -> Recording:
        """Return the same recording with every ``n``-th frame, the first among them."""
        return dataclasses.replace(self, entries=self.entries[::n])

    def picked(self, indices: NDArray[np.integer]) -> Recording:
        """Return the same recording with the frames of these numbers (M,) only, increasing."""
        return dataclasses.replace(self, entries=tuple(self.entries[int(k)] for k in indices))

    def frame(self, index: int) -> RGBDFrame:
        """Decode frame ``index``: depth in metres, 0 = no reading; colour black if there is none.

        Raises:
            InputError: a file that is missing, truncated, of another kind or size; the message
                names it and the line that lists it.
        """
        entry = self.entries[index]
        try:
            read, raw = entry.read(self.source)
        except InputError as error:
            raise InputError(f"{entry.where}: {error}") from None
        depth: NDArray[Any] = raw.astype(np.float32) / np.float32(self.depth_scale)
        if self.no_reading is not None:
            depth[raw == self.no_reading] = 0
        color: NDArray[Any] = np.zeros((*raw.shape, 3), np.uint8) if read is None else read
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
        if self.registration is not None and entry.color is not None:
            factor = self.intrinsics.width / crop.width
            color = self.registration.register(color, depth, self.intrinsics, factor)
        return RGBDFrame(np.ascontiguousarray(color), np.ascontiguousarray(depth), entry.timestamp)


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
