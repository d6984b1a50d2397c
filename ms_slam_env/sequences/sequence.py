"""RGB-D frames with their true poses, as far as known."""

from __future__ import annotations

import collections.abc
import warnings
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError, InputWarning


class Frames(collections.abc.Sequence[RGBDFrame]):
    """Frames that are rendered or decoded on request."""

    @abstractmethod
    def frame(self, index: int) -> RGBDFrame:
        """Make one frame."""

    @overload
    def __getitem__(self, index: int) -> RGBDFrame: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[RGBDFrame, ...]: ...

    def __getitem__(self, index: int | slice) -> RGBDFrame | tuple[RGBDFrame, ...]:
        if isinstance(index, slice):
            return tuple(self.frame(number) for number in range(len(self))[index])
        return self.frame(index)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self.frame(index) for index in range(len(self)))


@dataclass(frozen=True)
class Sequence:
    """Frames and the poses they were taken from.

    Iterating gives pairs (frame, T_world_camera (4, 4)).

    Attributes:
        frames: N frames; those of a rendered or recorded sequence are rendered or decoded on every
            request, always with the same result. ``tuple(sequence.frames)`` keeps them all.
        poses: (N, 4, 4) float64 true T_world_camera; NaN if not known.
        intrinsics: intrinsics of all frames.
        name: name for tables and files.

    Raises:
        InputError: the numbers of frames and poses differ.
    """

    frames: collections.abc.Sequence[RGBDFrame]
    poses: Float64
    intrinsics: Intrinsics
    name: str

    def __post_init__(self) -> None:
        """Refuse different numbers of frames and poses."""
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
        """Whether each frame's true pose is known, (N,)."""
        return np.asarray(np.isfinite(self.poses).all(axis=(1, 2)))

    @property
    def start(self) -> Float64 | None:
        """True pose (4, 4) of the first frame; None if not known."""
        return self.poses[0] if self.known[0] else None

    def true_trajectory(self) -> tuple[Float64, Float64] | None:
        """Known times (M,) in seconds and true T_world_camera (M, 4, 4); None if there are none."""
        known = self.known
        return (self.timestamps[known], self.poses[known]) if known.any() else None

    def true_depth(self, index: int) -> NDArray[np.float32]:
        """Best known depth (H, W) in metres of frame ``index``."""
        return self.frames[index].depth

    def check_depth(self) -> None:
        """Refuse a sequence without any depth.

        Raises:
            InputError: no frame has a depth reading.
        """
        if not any(frame.depth.any() for frame in self.frames):
            raise InputError(f"sequence {self.name}: no frame has a depth reading")

    def picked(self, indices: NDArray[np.integer]) -> Sequence:
        """Select the frames with these numbers (M,), increasing."""
        frames = tuple(self.frames[int(index)] for index in indices)
        return replace(self, frames=frames, poses=self.poses[indices])

    def where_known(self) -> Sequence:
        """Drop frames without a known true pose, with a warning.

        Raises:
            InputError: fewer than two frames are left.
        """
        known = self.known
        if not known.any():
            raise InputError(f"sequence {self.name} has no true trajectory to compare with")
        if known.sum() < 2:
            raise InputError(f"sequence {self.name}: fewer than 2 frames have a true pose")
        if known.all():
            return self
        text = f"sequence {self.name}: {self.said_known()}; the others are left out"
        warnings.warn(text, InputWarning, stacklevel=2)
        return self.picked(np.flatnonzero(known))

    def said_known(self) -> str:
        """Describe how many frames have a true pose."""
        return f"{int(self.known.sum())} of {len(self)} frames have a true pose"
