# Warp annotations are values, not types.
# mypy: ignore-errors
"""Counting kernels: one pass over the pixels of a batch of frames.

Counts are integers, so the result does not depend on the order in which a GPU adds them. One
thread takes one image row: on the CPU, where threads run one after the other, the call of a
thread costs more than a pixel does.
"""

from __future__ import annotations

from ms_slam_env._warp import wp

DITHER_U = wp.constant(0.7548776662466927)
DITHER_V = wp.constant(0.5698402909980532)
"""Steps of the two-dimensional low-discrepancy sequence R2 (Roberts, 2018)."""


@wp.kernel
def invert_depth(
    depth: wp.array3d(dtype=wp.float32),
    inverse: wp.array3d(dtype=wp.float32),
):
    """Inverse depth in 1/m; where there is no reading, a number too large to be one."""
    b, v = wp.tid()
    for u in range(depth.shape[2]):
        inverse[b, v, u] = 1.0 / wp.max(depth[b, v, u], 1.0e-20)


@wp.func
def depth_normal(
    inverse: wp.array3d(dtype=wp.float32),
    b: int,
    v: int,
    u: int,
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
):
    """Normal towards the camera, of any length; zero if there is none.

    On the plane n . p = d the inverse depth is n . ray / d, linear in the pixel coordinates, so
    its slopes give n / d exactly; d < 0 for a normal towards the camera. The slopes are central
    differences over ``radius`` pixels to both sides. The second difference is zero on a plane
    however tilted, so a large one shows an edge.
    """
    n = wp.vec3(0.0, 0.0, 0.0)
    if (
        u >= radius
        and v >= radius
        and u + radius < inverse.shape[2]
        and v + radius < inverse.shape[1]
    ):
        w = inverse[b, v, u]
        left = inverse[b, v, u - radius]
        right = inverse[b, v, u + radius]
        above = inverse[b, v - radius, u]
        below = inverse[b, v + radius, u]
        max_bend = edge_threshold * w
        if (
            w < 1.0e10
            and wp.abs(left + right - 2.0 * w) < max_bend
            and wp.abs(above + below - 2.0 * w) < max_bend
        ):
            scale = 0.5 / float(radius)
            slope_u = (right - left) * scale
            slope_v = (below - above) * scale
            n = wp.vec3(
                -focal[0] * slope_u,
                -focal[1] * slope_v,
                slope_u * (float(u) - centre[0]) + slope_v * (float(v) - centre[1]) - w,
            )
    return n


@wp.func
def direction_cell(n: wp.vec3, dither: wp.vec2, size: int):
    """Cell of direction ``n`` (any length but 0) in an octahedral map with -z at its centre.

    The direction lies between four cell centres. ``dither`` in [0, 1)^2 picks one of them with
    the frequency of its weight in bilinear interpolation.
    """
    scale = 1.0 / (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2]))
    x = n[0] * scale
    y = n[1] * scale
    if n[2] > 0.0:
        folded_x = (1.0 - wp.abs(y)) * wp.sign(x)
        y = (1.0 - wp.abs(x)) * wp.sign(y)
        x = folded_x
    half = 0.5 * float(size)
    # Adding 1 before truncation and taking it off after keeps truncation a floor below 0.
    column = int((x + 1.0) * half + dither[0] + 0.5) - 1
    row = int((y + 1.0) * half + dither[1] + 0.5) - 1
    return wp.clamp(row, 0, size - 1) * size + wp.clamp(column, 0, size - 1)


@wp.func
def dither_of(v: int, u: int):
    """Offset in [0, 1)^2 of a pixel: evenly spread over any patch of the image."""
    index_u = float(u)
    index_v = float(v)
    x = index_u * DITHER_U + index_v * DITHER_V
    y = index_u * DITHER_V + index_v * (1.0 - DITHER_U)
    return wp.vec2(x - float(int(x)), y - float(int(y)))


@wp.kernel
def count_intensity(
    intensity: wp.array3d(dtype=wp.float32),
    depth: wp.array3d(dtype=wp.float32),
    only_with_depth: int,
    windows: wp.vec2i,
    counts: wp.array2d(dtype=wp.int32),
):
    """Add a row of pixels to the grey levels (B, windows * 256) of its frame."""
    b, v = wp.tid()
    width = intensity.shape[2]
    window_row = v * windows[0] / intensity.shape[1] * windows[1]
    for u in range(width):
        if only_with_depth == 0 or depth[b, v, u] > 0.0:
            level = wp.clamp(int(intensity[b, v, u] + 0.5), 0, 255)
            window = window_row + u * windows[1] / width
            wp.atomic_add(counts, b, window * 256 + level, 1)


@wp.kernel
def count_depth_normals(
    inverse: wp.array3d(dtype=wp.float32),
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
    windows: wp.vec2i,
    size: int,
    counts: wp.array2d(dtype=wp.int32),
):
    """Add the normals of a row of pixels to the cells (B, windows * size^2) of its frame."""
    b, v = wp.tid()
    width = inverse.shape[2]
    window_row = v * windows[0] / inverse.shape[1] * windows[1]
    for u in range(width):
        n = depth_normal(inverse, b, v, u, focal, centre, radius, edge_threshold)
        if wp.dot(n, n) > 0.0:
            window = window_row + u * windows[1] / width
            cell = direction_cell(n, dither_of(v, u), size)
            wp.atomic_add(counts, b, window * size * size + cell, 1)


@wp.kernel
def count_given_normals(
    normals: wp.array3d(dtype=wp.vec3),
    windows: wp.vec2i,
    size: int,
    counts: wp.array2d(dtype=wp.int32),
):
    """Add given normals of a row of pixels to the cells (B, windows * size^2) of its frame."""
    b, v = wp.tid()
    width = normals.shape[2]
    window_row = v * windows[0] / normals.shape[1] * windows[1]
    for u in range(width):
        n = normals[b, v, u]
        if wp.dot(n, n) > 0.0:
            window = window_row + u * windows[1] / width
            cell = direction_cell(n, dither_of(v, u), size)
            wp.atomic_add(counts, b, window * size * size + cell, 1)


@wp.kernel
def compute_normals(
    inverse: wp.array3d(dtype=wp.float32),
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
    normals: wp.array3d(dtype=wp.vec3),
):
    """Unit normals of every pixel, zero where there is none."""
    b, v, u = wp.tid()
    normals[b, v, u] = wp.normalize(
        depth_normal(inverse, b, v, u, focal, centre, radius, edge_threshold)
    )
