"""A recorded sequence, read from disk frame by frame."""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame
from ms_slam_env.camera.frame import reduce_color, reduce_depth
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.sequences.recording.registration import Registration

Float64 = NDArray[np.float64]

# What Pillow raises for files that are missing, truncated or damaged, format by format.
_BROKEN_IMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    IndexError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)

NATIVE = "native"
"""The image size that keeps the recording's own."""


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


@dataclass(frozen=True)
class Recording(Sequence[RGBDFrame]):
    """Frames in order of time; each is decoded when it is asked for.

    Attributes:
        name: for tables and files.
        layout: name of the folder layout it was read with.
        entries: N frames.
        source: intrinsics of the images on disk.
        intrinsics: intrinsics of the frames that are returned.
        depth_scale: value of a depth image for one metre.
        no_reading: value of a depth image, besides 0, that means no reading.
        truth_times: (M,) seconds, or None.
        truth: (M, 4, 4) true T_world_camera, or None.
        registration: where the colour camera is, if colour has to be brought into the depth
            camera; None where the recording has that done.

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

        Raises:
            InputError: an unknown size, or one of another shape than the images on disk.
        """
        if size == NATIVE:
            return dataclasses.replace(self, intrinsics=self.source)
        if size not in XTION_SIZES:
            raise unknown("image size", size, (NATIVE, *XTION_SIZES))
        width, height = XTION_SIZES[size]
        factor = width / self.source.width
        if round(self.source.height * factor) != height or factor > 1:
            raise InputError(
                f"sequence {self.name}: images of {self.source.width}x{self.source.height} "
                f"cannot be reduced to {size}"
            )
        return dataclasses.replace(self, intrinsics=self.source.scaled(factor))

    def every(self, n: int) -> Recording:
        """Return the same recording with every ``n``-th frame, the first among them."""
        return dataclasses.replace(self, entries=self.entries[::n])

    def picked(self, indices: NDArray[np.integer]) -> Recording:
        """Return the same recording with the frames of these numbers (M,) only, increasing."""
        return dataclasses.replace(self, entries=tuple(self.entries[int(k)] for k in indices))

    @overload
    def __getitem__(self, index: int) -> RGBDFrame: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[RGBDFrame, ...]: ...

    def __getitem__(self, index: int | slice) -> RGBDFrame | tuple[RGBDFrame, ...]:
        """Decode a frame, or several; see `frame`."""
        if isinstance(index, slice):
            return tuple(self.frame(number) for number in range(len(self))[index])
        return self.frame(index)

    def frame(self, index: int) -> RGBDFrame:
        """Decode frame ``index``: depth in metres, 0 = no reading; colour black if there is none.

        Raises:
            InputError: a file that is missing, truncated, of another kind or size; the message
                names it and the line that lists it.
        """
        entry = self.entries[index]
        raw = self._read(entry.depth, entry, "a 16-bit depth image", ("I;16", "I;16B", "I", "L"))
        depth: NDArray[Any] = raw.astype(np.float32) / np.float32(self.depth_scale)
        if self.no_reading is not None:
            depth[raw == self.no_reading] = 0
        color: NDArray[Any] = np.zeros((*self.source.shape, 3), dtype=np.uint8)
        if entry.color is not None:
            color = self._read(entry.color, entry, "a colour image", ("RGB", "RGBA", "L", "P"))
        size = (self.intrinsics.width, self.intrinsics.height)
        if self.intrinsics.shape != self.source.shape:
            color = reduce_color(color, size)
            depth = reduce_depth(depth, size)
        if self.registration is not None and entry.color is not None:
            factor = self.intrinsics.width / self.source.width
            color = self.registration.register(color, depth, self.intrinsics, factor)
        return RGBDFrame(np.ascontiguousarray(color), np.ascontiguousarray(depth), entry.timestamp)

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Iterate over the frames."""
        return (self.frame(index) for index in range(len(self)))

    def _read(self, path: Path, entry: Entry, kind: str, modes: tuple[str, ...]) -> NDArray[Any]:
        try:
            with Image.open(path) as image:
                image.load()
                if image.mode not in modes:
                    raise InputError(f"{entry.where}: {path} is not {kind}, mode {image.mode}")
                pixels = np.asarray(image.convert("RGB") if modes[0] == "RGB" else image)
        except InputError:
            raise
        except _BROKEN_IMAGE as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{entry.where}: cannot read {path}: {reason}") from None
        self.source.check_image(pixels, f"{entry.where}: {path}")
        return pixels
