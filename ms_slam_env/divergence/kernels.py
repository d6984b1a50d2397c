# mypy: disable-error-code="empty-body"
"""Counting kernels: one pass over the pixels of a batch of frames.

Grey levels are counted as integers and normal weights are summed per row, so the result does not
depend on the order in which a GPU adds them. One thread handles one image row: on the CPU, where
threads run one after another, a call costs more than a pixel. The spatial window of pixel (v, u) is
``row_window[v] + column_window[u]``. Inner loops are in C++, because Warp's strided indexing takes
longer than the computation. So images must be contiguous.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source


@wp.func_native(native_source("histograms", "invert_row"))
def invert_row(depth: wp.array[wp.float32], width: int, inverse: wp.array[wp.float32]) -> None:
    """Compute the inverse depth of a row of pixels."""


@wp.kernel
def invert_depth(depth: wp.array3d[wp.float32], inverse: wp.array3d[wp.float32]) -> None:
    """Compute inverse depth in 1/m; without a reading, an impossibly large number."""
    b, v = wp.tid()
    invert_row(depth[b, v], depth.shape[2], inverse[b, v])


@wp.func
def plane_normal(
    w: float,
    left: float,
    right: float,
    above: float,
    below: float,
    edge_threshold: float,
    focal: wp.vec2,
    offset: wp.vec2,
    per_pixel: float,
) -> wp.vec3:
    """Normal facing the camera, of any length; zero if there is none.

    On the plane n . p = d the inverse depth is n . ray / d, linear in the pixel coordinates, so its
    slopes give n / d exactly; d < 0 for a normal facing the camera. The slopes are central
    differences of the inverse depths on both sides of ``w``. The second difference is zero on any
    plane, so a large one indicates an edge.

    ``offset`` is the pixel minus the centre, ``per_pixel`` 1 / the distance of the neighbours.
    """
    n = wp.vec3(0.0, 0.0, 0.0)
    max_bend = edge_threshold * w
    if (
        w < 1.0e10
        and wp.abs(left + right - 2.0 * w) < max_bend
        and wp.abs(above + below - 2.0 * w) < max_bend
    ):
        slope_u = (right - left) * per_pixel
        slope_v = (below - above) * per_pixel
        n = wp.vec3(
            -focal[0] * slope_u, -focal[1] * slope_v, slope_u * offset[0] + slope_v * offset[1] - w
        )
    return n


@wp.func
def normal_at(
    inverse: wp.array3d[wp.float32],
    b: int,
    v: int,
    u: int,
    radius: int,
    edge_threshold: float,
    focal: wp.vec2,
    centre: wp.vec2,
) -> wp.vec3:
    """Normal of pixel (v, u) of image ``b`` from its four neighbours at ``radius`` pixels."""
    return plane_normal(
        inverse[b, v, u],
        inverse[b, v, u - radius],
        inverse[b, v, u + radius],
        inverse[b, v - radius, u],
        inverse[b, v + radius, u],
        edge_threshold,
        focal,
        wp.vec2(float(u) - centre[0], float(v) - centre[1]),
        0.5 / float(radius),
    )


@wp.func
def direction_cell(n: wp.vec3, size: int) -> int:
    """Cell of direction ``n`` (any length but 0) in an octahedral map with -z at its centre."""
    half = 0.5 * float(size)
    scale = half / (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2]))
    x = n[0] * scale
    y = n[1] * scale
    if n[2] > 0.0:
        folded_x = (half - wp.abs(y)) * wp.sign(x)
        y = (half - wp.abs(x)) * wp.sign(y)
        x = folded_x
    row = wp.clamp(int(y + half), 0, size - 1)
    return row * size + wp.clamp(int(x + half), 0, size - 1)


@wp.func_native(native_source("histograms", "add_to_bins"))
def add_to_bins(
    n: wp.vec3,
    inverse: float,
    directions: wp.array[wp.vec3],
    near: wp.array2d[wp.int32],
    cell: int,
    cos_alpha: float,
    first: int,
    sums: wp.array[wp.float32],
) -> None:
    """Add the weights of direction ``n``, of length 1 / ``inverse``, to the bins near its cell."""


@wp.func
def add_weights(
    n: wp.vec3,
    directions: wp.array[wp.vec3],
    near: wp.array2d[wp.int32],
    size: int,
    cos_alpha: float,
    first: int,
    sums: wp.array[wp.float32],
) -> None:
    """Add the weights (8) of direction ``n``, times 1 - cos(alpha), to the bins from ``first``."""
    cell, inverse = direction_cell(n, size), 1.0 / wp.length(n)
    add_to_bins(n, inverse, directions, near, cell, cos_alpha, first, sums)


@wp.func_native(native_source("histograms", "count_row"))
def count_row(
    intensity: wp.array[wp.float32],
    depth: wp.array[wp.float32],
    only_with_depth: int,
    column_window: wp.array[wp.int32],
    width: int,
    first: int,
    counts: wp.array[wp.int32],
) -> None:
    """Count the grey levels of a row of pixels."""


@wp.kernel
def count_intensity(
    intensity: wp.array3d[wp.float32],
    depth: wp.array3d[wp.float32],
    only_with_depth: int,
    row_window: wp.array[wp.int32],
    column_window: wp.array[wp.int32],
    counts: wp.array2d[wp.int32],
) -> None:
    """Add a row of pixels to the grey levels (B, windows * 256) of its frame."""
    b, v = wp.tid()
    first = 256 * row_window[v]
    count_row(
        intensity[b, v],
        depth[b, v],
        only_with_depth,
        column_window,
        intensity.shape[2],
        first,
        counts[b],
    )


@wp.kernel
def weigh_depth_normals(
    inverse: wp.array3d[wp.float32],
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
    row_window: wp.array[wp.int32],
    column_window: wp.array[wp.int32],
    directions: wp.array[wp.vec3],
    near: wp.array2d[wp.int32],
    size: int,
    cos_alpha: float,
    per_row: int,
    sums: wp.array[wp.float32],
) -> None:
    """Sum the weights of the normals of a row of pixels, (B, H, windows * bins), equation (9)."""
    b, v = wp.tid()
    height = inverse.shape[1]
    width = inverse.shape[2]
    if v < radius or v >= height - radius:
        return
    window_row = row_window[v]
    first_of_row = (b * height + v) * per_row
    for u in range(radius, width - radius):
        n = normal_at(inverse, b, v, u, radius, edge_threshold, focal, centre)
        if wp.dot(n, n) > 0.0:
            window = window_row + column_window[u]
            first = first_of_row + window * directions.shape[0]
            add_weights(n, directions, near, size, cos_alpha, first, sums)


@wp.kernel
def weigh_given_normals(
    normals: wp.array3d[wp.vec3],
    row_window: wp.array[wp.int32],
    column_window: wp.array[wp.int32],
    directions: wp.array[wp.vec3],
    near: wp.array2d[wp.int32],
    size: int,
    cos_alpha: float,
    per_row: int,
    sums: wp.array[wp.float32],
) -> None:
    """Sum the weights of given normals of a row of pixels, (B, H, windows * bins), (9)."""
    b, v = wp.tid()
    width = normals.shape[2]
    window_row = row_window[v]
    first_of_row = (b * normals.shape[1] + v) * per_row
    for u in range(width):
        n = normals[b, v, u]
        if wp.dot(n, n) > 0.0:
            window = window_row + column_window[u]
            first = first_of_row + window * directions.shape[0]
            add_weights(n, directions, near, size, cos_alpha, first, sums)


@wp.kernel
def compute_normals(
    inverse: wp.array3d[wp.float32],
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
    normals: wp.array3d[wp.vec3],
) -> None:
    """Compute unit normals of a row of pixels; zero = none."""
    b, v = wp.tid()
    height = inverse.shape[1]
    width = inverse.shape[2]
    for u in range(width):
        n = wp.vec3(0.0, 0.0, 0.0)
        if v >= radius and v < height - radius and u >= radius and u < width - radius:
            n = normal_at(inverse, b, v, u, radius, edge_threshold, focal, centre)
        normals[b, v, u] = wp.normalize(n)


@wp.kernel
def add_rows(
    sums: wp.array[wp.float32],  # (B * H * K,)
    height: int,
    totals: wp.array2d[wp.float64],  # (B, K)
) -> None:
    """Add up the sums of the rows of each frame, from the top, in double precision."""
    b, k = wp.tid()
    columns = totals.shape[1]
    i = b * height * columns + k
    total = wp.float64(0.0)
    for _ in range(height):
        total += wp.float64(sums[i])
        i += columns
    totals[b, k] = total
