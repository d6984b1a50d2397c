# mypy: disable-error-code="empty-body"
"""Undo the rolling shutter: compute the frame that the camera would have seen at one instant.

The rows of an image are read one after the other, each from a different pose. The camera is assumed
to move at constant velocity between two frames, as on a piece of a continuous trajectory (Kerl,
Stueckler, Cremers, "Dense continuous-time tracking and mapping with rolling shutter RGB-D cameras",
ICCV 2015). Let xi = log(T_before^-1 T_now) be the twist of its motion between them. A point p of a
row that is read a share s of that time after the middle row lies at

    q = exp(s xi) p

in the camera of the middle row. Every pixel of the levelled image looks up the point of the frame
that falls into it. The frame is levelled with the last motion and aligned, then levelled with the
motion found and aligned again. The first frame has no known motion; it is mapped again once the
second one is aligned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import se3_log
from ms_slam_env.native import native_source
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.preprocessing import check_images

PIECE = 64  # columns processed together, by short loops that the compiler vectorizes


@wp.struct
class Rows:
    """Frames of B envs as they were read, flat, and the motion during the readout."""

    color: wp.array[wp.uint8]
    depth: wp.array[wp.float32]
    turn: wp.array[wp.vec3]  # (B,) rotation from the first row to the last, radians
    step: wp.array[wp.vec3]  # (B,) translation, metres
    size: wp.vec2i  # (width, height)
    focal: wp.vec2
    centre: wp.vec2


@wp.func_native(native_source("row_levelling", "level_piece", PIECE=PIECE))
def level_piece(
    rows: Rows,
    b: int,
    v: int,
    piece: int,
    color: wp.array[wp.uint8],
    depth: wp.array[wp.float32],
) -> None:
    """Fill a piece of row v of the levelled images of env b."""


@wp.kernel
def _level(
    rows: Rows,
    color: wp.array[wp.uint8],  # out
    depth: wp.array[wp.float32],  # out
) -> None:
    """Fill a piece of a row of the levelled images."""
    b, v, piece = wp.tid()
    level_piece(rows, b, v, piece, color, depth)


class _Leveller:
    """Buffers for the frames of B cameras, and the launch over them."""

    def __init__(self, batch: int, intrinsics: Intrinsics, device: str) -> None:
        shape = (batch, *intrinsics.shape)
        self._color = SavedBuffer((*shape, 3), wp.uint8, device)
        self._depth = SavedBuffer(shape, wp.float32, device)
        self._turn = SavedBuffer(batch, wp.vec3, device)
        self._step = SavedBuffer(batch, wp.vec3, device)
        self._levelled_color = SavedBuffer((*shape, 3), wp.uint8, device)
        self._levelled_depth = SavedBuffer(shape, wp.float32, device)
        rows, i = Rows(), intrinsics
        rows.color, rows.depth = self._color.array.flatten(), self._depth.array.flatten()
        rows.turn, rows.step = self._turn.array, self._step.array
        rows.size, rows.focal = wp.vec2i(i.width, i.height), wp.vec2(i.fx, i.fy)
        rows.centre = wp.vec2(i.cx, i.cy)
        dim = (batch, i.height, -(-i.width // PIECE))
        levelled = [self._levelled_color.array.flatten(), self._levelled_depth.array.flatten()]
        self._launch = RecordedLaunch(_level, dim, [rows, *levelled], device)

    def __call__(self, frames: Images, twists: Float64) -> Images:
        """Level frames that were read while the cameras moved by ``twists`` (B, 6).

        Images on the device are overwritten by the next call.
        """
        check_images(frames.color, frames.depth, self._depth.array.shape)
        self._color.write(frames.color)
        self._depth.write(frames.depth)
        self._turn.write(twists[:, 3:])
        self._step.write(twists[:, :3])
        self._launch.launch()
        levelled = self._levelled_color, self._levelled_depth
        if frames.on_device:
            return Images(*(buffer.array for buffer in levelled))
        return Images(*(buffer.read() for buffer in levelled))


class Shutter(Saved):
    """Levels frames of B envs whose last row is read ``readout_s`` after the first.

    Frames without a timestamp, or with one that is not later than the last, are left as they are;
    with ``readout_s`` 0 all are.
    """

    def __init__(self, batch: int, readout_s: float, device: str) -> None:
        self.is_rolling = readout_s > 0
        if self.is_rolling:
            self.saved = ("_times", "_intervals")  # type: ignore[misc]
        self._readout_s, self._device = readout_s, device
        self._times: Float64 = np.full(batch, np.nan)
        self._intervals: Float64 = np.full(batch, np.nan)  # since the previous frames
        self._leveller: _Leveller

    def use(self, intrinsics: Intrinsics) -> None:
        """Prepare for frames of a camera."""
        if self.is_rolling:
            self._leveller = _Leveller(len(self._times), intrinsics, self._device)

    def take_time(self, times_s: Sequence[float] | None) -> None:
        """Set the times (B,) of the present frames; ``level`` then takes the motions to them."""
        now = np.full_like(self._times, np.nan) if times_s is None else np.array(times_s, float)
        self._intervals, self._times = now - self._times, now

    def level(self, taken: Images, motions: Float64) -> Images:
        """Level frames whose cameras moved by ``motions`` (B, 4, 4) since the previous frames."""
        if not self.is_rolling:
            return taken
        is_later = self._intervals > 0
        share = self._readout_s / np.where(is_later, self._intervals, np.inf)
        return self._leveller(taken, share[:, None] * np.stack([se3_log(T) for T in motions]))

    def forget(self, envs: NDArray[np.integer[Any]]) -> None:
        """Know no earlier frame of the ``envs`` (N,)."""
        self._times[envs] = self._intervals[envs] = np.nan
