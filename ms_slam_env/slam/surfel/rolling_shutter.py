# mypy: disable-error-code="empty-body"
"""Frames of a rolling shutter, made into what the camera would have seen at one instant.

The rows of an image are read one after the other, so each is seen from a place of its own. Between
two frames the camera is taken to move evenly, as on the straight pieces of a continuous trajectory
(Kerl, Stueckler, Cremers, "Dense continuous-time tracking and mapping with rolling shutter RGB-D
cameras", ICCV 2015): with the twist xi = log(T_before^-1 T_now) of its motion over the time between
them, a point p of the row that is read a share s of that time after the middle row lies at

    q = exp(s xi) p

in the camera of the middle row. Every pixel of the levelled image looks up which point of the
frame comes to lie in it. The frame is levelled with the last motion, aligned, and levelled and
aligned once more with the motion that was found. The first frame, of which nothing is known, is
mapped anew once the second one has been found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ms_slam_env._warp import RecordedLaunch, wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import se3_log
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.state import Saved
from ms_slam_env.slam.surfel.device import HostDeviceBuffer
from ms_slam_env.slam.surfel.preprocessing import check_images
from ms_slam_env.slam.surfel.relocalization import Images

PIECE = 64  # columns that are worked on together, by short loops over several of them at once


@wp.struct
class Rows:
    """Frames of B envs as they were read, flat, and the motion that goes with them."""

    color: wp.array(dtype=wp.uint8)
    depth: wp.array(dtype=wp.float32)
    turn: wp.array(dtype=wp.vec3)  # (B,) over the time from the first row to the last, radians
    step: wp.array(dtype=wp.vec3)  # metres
    size: wp.vec2i  # (width, height)
    focal: wp.vec2
    centre: wp.vec2


@wp.func_native(
    f"constexpr int PIECE = {PIECE};"
    + """
constexpr int STEPS = 2;  // of the search for the point that comes to lie in a pixel
constexpr float NEAR_SQUARED = 0.25f;  // a pixel in which none does, to half a pixel, has no depth
constexpr float SAME_SURFACE = 0.03f;  // largest difference of inverse depth of one surface, 1/m
const int width = rows.size[0], height = rows.size[1];
const int first = piece * PIECE, n = width - first < PIECE ? width - first : PIECE;
const size_t image = size_t(b) * width * height;
const float* depths = rows.depth.data + image;
const unsigned char* colors = rows.color.data + 3 * image;
const float fx = rows.focal[0], fy = rows.focal[1], cx = rows.centre[0], cy = rows.centre[1];
const float per_fx = 1.0f / fx, per_fy = 1.0f / fy, per_height = 1.0f / (float)height;
const float last_u = (float)(width - 1), last_v = (float)(height - 1);
const wp::vec_t<3, float> turn = rows.turn.data[b], step = rows.step.data[b];
const auto clamped = [](float value, float most) {
    const float low = value > 0.0f ? value : 0.0f;
    return low < most ? low : most;
};
float x[PIECE], y[PIECE], z[PIECE], qx[PIECE], qy[PIECE], qz[PIECE];
// Where the points at depth z of row y lie at the time of the middle row: to second order in the
// turn; what has no depth, z = 0, is far away.
const auto to_middle = [&]() {
    for (int k = 0; k < n; ++k) {
        const float s = (y[k] + 0.5f) * per_height - 0.5f;
        const float scale = z[k] > 0.0f ? z[k] : 1.0f, moves = z[k] > 0.0f ? s : 0.0f;
        const float px = scale * (x[k] - cx) * per_fx, py = scale * (y[k] - cy) * per_fy;
        const float wx = s * turn[0], wy = s * turn[1], wz = s * turn[2];
        const float mx = wy * scale - wz * py + moves * step[0];
        const float my = wz * px - wx * scale + moves * step[1];
        const float mz = wx * py - wy * px + moves * step[2];
        qx[k] = px + mx + 0.5f * (wy * mz - wz * my);
        qy[k] = py + my + 0.5f * (wz * mx - wx * mz);
        qz[k] = scale + mz + 0.5f * (wx * my - wy * mx);
    }
};
float gap[PIECE], right[PIECE], down[PIECE], nearest[PIECE];
int at[PIECE], is_inside[PIECE];
const auto look = [&](int i) {
    return depths[(int)(clamped(y[i], last_v) + 0.5f) * width
        + (int)(clamped(x[i], last_u) + 0.5f)];
};
for (int k = 0; k < n; ++k) {
    x[k] = (float)(first + k);
    y[k] = (float)v;
}
for (int i = 0; i < STEPS; ++i) {
    for (int k = 0; k < n; ++k) z[k] = look(k);
    to_middle();
    for (int k = 0; k < n; ++k) {
        const float per_z = 1.0f / qz[k];
        const float gap_x = (float)(first + k) - (fx * qx[k] * per_z + cx);
        const float gap_y = (float)v - (fy * qy[k] * per_z + cy);
        gap[k] = gap_x * gap_x + gap_y * gap_y;
        x[k] += gap_x;
        y[k] += gap_y;
    }
}
for (int k = 0; k < n; ++k) {
    is_inside[k] = (x[k] > -0.5f) & (y[k] > -0.5f) & (x[k] < last_u + 0.5f)
        & (y[k] < last_v + 0.5f) & (gap[k] < NEAR_SQUARED);
    const float u = clamped(x[k], last_u), w = clamped(y[k], last_v);
    const int column = (int)clamped(u, last_u - 1.0f), row = (int)clamped(w, last_v - 1.0f);
    right[k] = u - (float)column;
    down[k] = w - (float)row;
    at[k] = row * width + column;
}
// Inverse depth between the pixels that show the surface of the nearest one.
for (int k = 0; k < n; ++k) nearest[k] = look(k);
for (int k = 0; k < n; ++k) {
    float sum = 0.0f, whole = 0.0f;
    for (int i = 0; i < 4; ++i) {
        const float there = depths[at[k] + (i / 2) * width + i % 2];
        const bool is_same = (there > 0.0f)
            & (fabsf(nearest[k] - there) <= SAME_SURFACE * nearest[k] * there);
        const float weight
            = (i % 2 ? right[k] : 1.0f - right[k]) * (i / 2 ? down[k] : 1.0f - down[k]);
        whole += is_same ? weight : 0.0f;
        sum += is_same ? weight / there : 0.0f;
    }
    z[k] = sum > 0.0f ? whole / sum : nearest[k];
}
to_middle();
const size_t here = image + size_t(v) * width + first;
for (int k = 0; k < n; ++k)
    depth.data[here + k] = is_inside[k] && nearest[k] > 0.0f ? qz[k] : 0.0f;
for (int k = 0; k < n; ++k) {
    for (int c = 0; c < 3; ++c) {
        const unsigned char* p = colors + 3 * at[k] + c;
        const unsigned char* q = p + 3 * width;
        const float top = p[0] + right[k] * (float)(p[3] - p[0]);
        const float low = q[0] + right[k] * (float)(q[3] - q[0]);
        color.data[3 * (here + k) + c] = (unsigned char)(top + down[k] * (low - top) + 0.5f);
    }
}
"""
)
def level_piece(
    rows: Rows,
    b: int,
    v: int,
    piece: int,
    color: wp.array(dtype=wp.uint8),
    depth: wp.array(dtype=wp.float32),
):
    """Fill a piece of row v of the levelled images of env b, all of its pixels step by step."""


@wp.kernel
def _level(
    rows: Rows,
    color: wp.array(dtype=wp.uint8),  # out
    depth: wp.array(dtype=wp.float32),  # out
):
    """Fill a piece of a row of the levelled images."""
    b, v, piece = wp.tid()
    level_piece(rows, b, v, piece, color, depth)


class _Leveller:
    """Buffers for the frames of B cameras, and the launch over them."""

    def __init__(self, batch: int, intrinsics: Intrinsics, device: str) -> None:
        shape = (batch, *intrinsics.shape)
        self._color = HostDeviceBuffer((*shape, 3), wp.uint8, device)
        self._depth = HostDeviceBuffer(shape, wp.float32, device)
        self._turn = HostDeviceBuffer(batch, wp.vec3, device)
        self._step = HostDeviceBuffer(batch, wp.vec3, device)
        self._levelled_color = HostDeviceBuffer((*shape, 3), wp.uint8, device)
        self._levelled_depth = HostDeviceBuffer(shape, wp.float32, device)
        rows, i = Rows(), intrinsics
        rows.color, rows.depth = self._color.array.flatten(), self._depth.array.flatten()
        rows.turn, rows.step = self._turn.array, self._step.array
        rows.size, rows.focal = wp.vec2i(i.width, i.height), wp.vec2(i.fx, i.fy)
        rows.centre = wp.vec2(i.cx, i.cy)
        dim = (batch, i.height, -(-i.width // PIECE))
        levelled = [self._levelled_color.array.flatten(), self._levelled_depth.array.flatten()]
        self._launch = RecordedLaunch(_level, dim, [rows, *levelled], device)

    def __call__(self, frames: Images, twists: Float64) -> Images:
        """Level frames that were read while the cameras moved by ``twists`` (B, 6)."""
        check_images(frames.color, frames.depth, self._depth.array.shape)
        self._color.write(frames.color)
        self._depth.write(frames.depth)
        self._turn.write(twists[:, 3:])
        self._step.write(twists[:, :3])
        self._launch.launch()
        return Images(self._levelled_color.read(), self._levelled_depth.read())


class Shutter(Saved):
    """How the rows of the frames of B envs are taken; here all at once."""

    is_rolling = False

    def use(self, intrinsics: Intrinsics) -> None:
        """Expect frames of a camera."""

    def take_time(self, times_s: Sequence[float] | None) -> None:
        """From now on motions are those that led to the frames of these times (B,)."""

    def level(self, taken: Images, motions: Float64) -> Images:
        """The frames as of one instant, with cameras that move like ``motions`` (B, 4, 4)."""
        return taken

    def forget(self, env: int) -> None:
        """Know no earlier frame of an env."""


class RollingShutter(Shutter):
    """Rows that are read one after the other, the last of them ``readout_s`` after the first.

    Frames whose time is not known, or is not after the last one's, are left as they are.
    """

    saved = ("_times", "_intervals")
    is_rolling = True

    def __init__(self, batch: int, readout_s: float, device: str) -> None:
        self._readout_s, self._device = readout_s, device
        self._times: Float64 = np.full(batch, np.nan)
        self._intervals: Float64 = np.full(batch, np.nan)  # between them and those before
        self._leveller: _Leveller

    def use(self, intrinsics: Intrinsics) -> None:
        """See the base class."""
        self._leveller = _Leveller(len(self._times), intrinsics, self._device)

    def take_time(self, times_s: Sequence[float] | None) -> None:
        """See the base class."""
        now = np.full_like(self._times, np.nan) if times_s is None else np.array(times_s, float)
        self._intervals, self._times = now - self._times, now

    def level(self, taken: Images, motions: Float64) -> Images:
        """See the base class."""
        is_later = self._intervals > 0
        share = self._readout_s / np.where(is_later, self._intervals, np.inf)
        return self._leveller(taken, share[:, None] * np.stack([se3_log(T) for T in motions]))

    def forget(self, env: int) -> None:
        """See the base class."""
        self._times[env] = self._intervals[env] = np.nan


def make_shutter(batch: int, readout_s: float, device: str) -> Shutter:
    """The shutter of B envs whose rows take ``readout_s``; 0: all are taken at once."""
    return RollingShutter(batch, readout_s, device) if readout_s else Shutter()
