# ruff: noqa: UP018, RUF046
"""Kernels of the motion mask: evidence of motion on a grid of pixels, carried and applied."""

from __future__ import annotations

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.device import fetch, put

PAST = wp.constant(6)  # earlier frames that the live one is compared with
KNOWN, SUPPORTED, APPEARED, VANISHED = (wp.constant(1 << bit) for bit in range(4))
"""Of a reading: an earlier frame saw its place; it was there in an old one already; its place was
free; what was in front of it has gone."""
UNUSED, RECENT, OLD = (wp.constant(age) for age in range(3))
RECEDED_M = wp.constant(0.6)  # what is farther behind did not recede there, but was uncovered
NEAREST_M = wp.constant(0.03)  # smallest distance that is no noise


@wp.struct
class Grid:
    """Every ``stride``-th row and column of the live images of B envs."""

    stride: int
    width: int
    height: int
    live_width: int
    live_height: int
    focal: wp.vec2
    centre: wp.vec2
    sigma: float  # tolerance at 1 m, grows with depth squared


def make_grid(intrinsics: Intrinsics, columns: int, sigma: float) -> Grid:
    """A grid of about so many columns; ``sigma`` is its tolerance at 1 m."""
    stride = max(1, round(intrinsics.width / columns))
    small = intrinsics.every_nth(stride)
    grid = Grid()
    grid.stride, grid.width, grid.height = stride, small.width, small.height
    grid.live_width, grid.live_height = intrinsics.width, intrinsics.height
    grid.focal, grid.centre = wp.vec2(small.fx, small.fy), wp.vec2(small.cx, small.cy)
    grid.sigma = sigma
    return grid


@wp.func
def tolerance(z: float, grid: Grid):
    """Difference of depth, metres, that is neither noise nor an inexact pose."""
    return wp.max(grid.sigma * z * z, NEAREST_M)


@wp.func
def place(p: wp.vec3, grid: Grid):
    """Pixel of the grid where a point of the camera's frame is seen; -1 outside."""
    if p[2] < 0.05:
        return -1
    u = int(grid.focal[0] * p[0] / p[2] + grid.centre[0] + 100.5) - 100
    v = int(grid.focal[1] * p[1] / p[2] + grid.centre[1] + 100.5) - 100
    if u < 0 or v < 0 or u >= grid.width or v >= grid.height:
        return -1
    return v * grid.width + u


@wp.func
def point(u: int, v: int, z: float, grid: Grid):
    """Point of the camera's frame at a pixel of the grid."""
    x = (float(u) - grid.centre[0]) / grid.focal[0]
    y = (float(v) - grid.centre[1]) / grid.focal[1]
    return wp.vec3(z * x, z * y, z)


@wp.func
def times(T: wp.mat44, p: wp.vec3):
    """Point p moved by T."""
    return wp.vec3(
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@wp.kernel
def sample_depth(
    filtered: wp.array(dtype=wp.float32),
    raw: wp.array(dtype=wp.float32),
    grid: Grid,
    depth: wp.array(dtype=wp.float32),
    nearest: wp.array(dtype=wp.float32),
):
    """Filtered depth on the grid, and the smallest raw reading around each of its pixels.

    Where the pixel itself has no reading it is 0: what lies there is not known.
    """
    b, v = wp.tid()
    image = b * grid.live_height * grid.live_width
    row = (b * grid.height + v) * grid.width
    u = int(0)
    while u < grid.width:
        centre = image + v * grid.stride * grid.live_width + u * grid.stride
        put(depth, row + u, fetch(filtered, centre))
        least = fetch(raw, centre)
        if least > 0.0:
            y = wp.max(v - 1, 0)
            while y <= wp.min(v + 1, grid.height - 1):
                x = wp.max(u - 1, 0)
                while x <= wp.min(u + 1, grid.width - 1):
                    at = image + y * grid.stride * grid.live_width + x * grid.stride
                    near = fetch(raw, at)
                    least = wp.where(near > 0.0, wp.min(near, least), least)
                    x += 1
                y += 1
        put(nearest, row + u, least)
        u += 1


@wp.kernel
def find_appeared(
    depth: wp.array(dtype=wp.float32),
    past_nearest: wp.array(dtype=wp.float32),
    past_depth: wp.array(dtype=wp.float32),
    T_past_live: wp.array2d(dtype=wp.mat44),  # (B, PAST)
    age: wp.array2d(dtype=wp.int32),  # (B, PAST)
    grid: Grid,
    found: wp.array(dtype=wp.int32),
):
    """Which readings are where an earlier frame saw free space, and of which that is known."""
    b, v = wp.tid()
    row = (b * grid.height + v) * grid.width
    pixels = grid.height * grid.width
    u = int(0)
    while u < grid.width:
        result = int(0)
        z = fetch(depth, row + u)
        if z > 0.0:
            p = point(u, v, z, grid)
            for k in range(PAST):
                if age[b, k] != UNUSED and result < APPEARED:
                    q = times(T_past_live[b, k], p)
                    at = place(q, grid)
                    if at >= 0:
                        near = fetch(past_nearest, (b * PAST + k) * pixels + at)
                        if near > 0.0:
                            off = tolerance(q[2], grid)
                            here = wp.abs(fetch(past_depth, (b * PAST + k) * pixels + at) - q[2])
                            result |= wp.where(near > q[2] + off, KNOWN | APPEARED, KNOWN)
                            if age[b, k] == OLD and here < off:
                                result |= SUPPORTED
        put(found, row + u, result)
        u += 1


@wp.kernel
def find_vanished(
    nearest: wp.array(dtype=wp.float32),
    past_depth: wp.array(dtype=wp.float32),
    masked: wp.array(dtype=wp.int32),  # (B * h * w), of the live frames as far as is known
    T_live_past: wp.array2d(dtype=wp.mat44),  # (B, PAST)
    age: wp.array2d(dtype=wp.int32),  # (B, PAST)
    grid: Grid,
    found: wp.array(dtype=wp.int32),
):
    """Mark where the live frame looks through a point of an earlier frame.

    What was known to move has left its place anyway: that says nothing of what it has uncovered.
    """
    b, k, v = wp.tid()
    if age[b, k] != OLD:  # since then it has gone far enough to tell
        return
    pixels = grid.height * grid.width
    row = (b * PAST + k) * pixels + v * grid.width
    u = int(0)
    while u < grid.width:
        moved = fetch(past_depth, row + u) < 0.0
        z = wp.abs(fetch(past_depth, row + u))
        if z > 0.0:
            q = times(T_live_past[b, k], point(u, v, z, grid))
            at = place(q, grid)
            if at >= 0:
                i = b * pixels + at
                behind = fetch(nearest, i) - q[2]
                is_through = behind > tolerance(q[2], grid) and behind < RECEDED_M
                if is_through and (not moved or fetch(masked, i) != 0):
                    put(found, i, fetch(found, i) | VANISHED)
        u += 1


@wp.kernel
def carry_log_odds(
    depth: wp.array(dtype=wp.float32),
    last_depth: wp.array(dtype=wp.float32),
    last_odds: wp.array(dtype=wp.float32),
    T_last_live: wp.array(dtype=wp.mat44),
    grid: Grid,
    odds: wp.array(dtype=wp.float32),
):
    """Log-odds of the last frame at the live readings: from the pixel around of the next depth."""
    b, v = wp.tid()
    row = (b * grid.height + v) * grid.width
    pixels = grid.height * grid.width
    u = int(0)
    while u < grid.width:
        value = float(0.0)
        z = fetch(depth, row + u)
        if z > 0.0:
            q = times(T_last_live[b], point(u, v, z, grid))
            at = place(q, grid)
            if at >= 0:
                closest = 0.03 * q[2]
                column = at % grid.width
                line = at / grid.width
                for step in range(9):
                    k = (step + 4) % 9  # the middle first
                    x = column + k % 3 - 1
                    y = line + k / 3 - 1
                    if x >= 0 and y >= 0 and x < grid.width and y < grid.height:
                        i = b * pixels + y * grid.width + x
                        gap = wp.abs(fetch(last_depth, i) - q[2])
                        if gap < closest and (step == 0 or closest == 0.03 * q[2]):
                            closest = gap
                            value = fetch(last_odds, i)
        put(odds, row + u, value)
        u += 1


@wp.kernel
def hide(
    T_live_model: wp.array(dtype=wp.mat44),
    masked: wp.array(dtype=wp.int32),  # (B * h * w) of the grid
    grid: Grid,
    vertices: wp.array2d(dtype=wp.vec3),  # (B, pixels) of the model view
    normals: wp.array2d(dtype=wp.vec3),
    intensity: wp.array2d(dtype=wp.float32),
):
    """Leave what the masked readings lie upon out of a view of the map."""
    b, i = wp.tid()
    p = vertices[b, i]
    if p[2] > 0.0:
        at = place(times(T_live_model[b], p), grid)
        if at >= 0 and fetch(masked, b * grid.height * grid.width + at) != 0:
            nothing = wp.vec3(0.0, 0.0, 0.0)
            vertices[b, i] = nothing
            normals[b, i] = nothing
            intensity[b, i] = 0.0


@wp.kernel
def enlarge(masked: wp.array(dtype=wp.int32), grid: Grid, image: wp.array(dtype=wp.int32)):
    """The mask of the grid at the size of the live images."""
    b, v = wp.tid()
    half = grid.stride / 2
    line = wp.min((v + half) / grid.stride, grid.height - 1)
    row = (b * grid.height + line) * grid.width
    live_row = (b * grid.live_height + v) * grid.live_width
    u = int(0)
    column = int(0)
    while u < grid.live_width:
        next_column = wp.min(grid.stride * (column + 1) - half, grid.live_width)
        next_column = wp.where(column == grid.width - 1, grid.live_width, next_column)
        value = fetch(masked, row + column)
        while u < next_column:
            put(image, live_row + u, value)
            u += 1
        column += 1
