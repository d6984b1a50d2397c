# mypy: ignore-errors  (Warp annotations are values, not types)
"""Counting kernels: one pass over the pixels of a batch of frames.

Counts are integers, so the result does not depend on the order in which a GPU adds them.
"""

from __future__ import annotations

from ms_slam_env._warp import wp


@wp.func
def slope(
    depth: wp.array3d(dtype=wp.float32),
    b: int,
    v: int,
    u: int,
    dv: int,
    du: int,
    radius: int,
    w: float,
    max_bend: float,
):
    """Slope of inverse depth at (v, u) along (dv, du), per pixel; NaN if there is none.

    Least squares over the pairs at distance 1 to ``radius`` whose second difference shows no
    edge. A plane has a linear inverse depth however it is tilted, so the second difference is 0.
    """
    height = depth.shape[1]
    width = depth.shape[2]
    numerator = wp.float32(0.0)  # a loop variable, not a constant
    denominator = wp.float32(0.0)  # a loop variable, not a constant
    for k in range(1, radius + 1):
        v0 = v - k * dv
        u0 = u - k * du
        v1 = v + k * dv
        u1 = u + k * du
        if v0 >= 0 and u0 >= 0 and v1 < height and u1 < width:
            z0 = depth[b, v0, u0]
            z1 = depth[b, v1, u1]
            if z0 > 0.0 and z1 > 0.0:
                w0 = 1.0 / z0
                w1 = 1.0 / z1
                if wp.abs(w0 + w1 - 2.0 * w) < max_bend:
                    numerator += float(k) * (w1 - w0)
                    denominator += 2.0 * float(k * k)
    if denominator == 0.0:
        return wp.nan
    return numerator / denominator


@wp.func
def depth_normal(
    depth: wp.array3d(dtype=wp.float32),
    b: int,
    v: int,
    u: int,
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
):
    """Normal towards the camera, not of unit length; zero if there is none.

    On the plane n . p = d the inverse depth is n . ray / d, linear in the pixel coordinates, so
    its slopes give n / d exactly; d < 0 for a normal towards the camera.
    """
    z = depth[b, v, u]
    if z <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    w = 1.0 / z
    max_bend = edge_threshold * w
    slope_u = slope(depth, b, v, u, 0, 1, radius, w, max_bend)
    slope_v = slope(depth, b, v, u, 1, 0, radius, w, max_bend)
    if wp.isnan(slope_u) or wp.isnan(slope_v):
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.vec3(
        -focal[0] * slope_u,
        -focal[1] * slope_v,
        slope_u * (float(u) - centre[0]) + slope_v * (float(v) - centre[1]) - w,
    )


@wp.func
def octahedral_cell(n: wp.vec3, size: int):
    """Cell of direction ``n`` (any length but 0) in the octahedral map of side ``size``."""
    scale = 1.0 / (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2]))
    x = n[0] * scale
    y = n[1] * scale
    if n[2] < 0.0:
        folded_x = (1.0 - wp.abs(y)) * wp.sign(x)
        folded_y = (1.0 - wp.abs(x)) * wp.sign(y)
        x = folded_x
        y = folded_y
    column = wp.clamp(int((x + 1.0) * 0.5 * float(size)), 0, size - 1)
    row = wp.clamp(int((y + 1.0) * 0.5 * float(size)), 0, size - 1)
    return row * size + column


@wp.func
def add_normal(
    n: wp.vec3,
    b: int,
    offset: int,
    size: int,
    starts: wp.array(dtype=wp.int32),
    bins: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
):
    """Equations (8) and (9) for one normal, by the weight table."""
    cell = octahedral_cell(n, size)
    for entry in range(starts[cell], starts[cell + 1]):
        wp.atomic_add(counts, b, offset + bins[entry], weights[entry])


@wp.kernel
def count_frames(
    intensity: wp.array3d(dtype=wp.float32),
    depth: wp.array3d(dtype=wp.float32),
    given_normals: wp.array3d(dtype=wp.vec3),
    use_given_normals: int,
    only_with_depth: int,
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
    windows: wp.vec2i,
    size: int,
    starts: wp.array(dtype=wp.int32),
    bins: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.int32),
    num_normal_bins: int,
    intensity_counts: wp.array2d(dtype=wp.int32),
    normal_counts: wp.array2d(dtype=wp.int32),
):
    """Add one pixel to the histograms of its frame and window.

    Counts: (B, windows * 256) grey levels and (B, windows * L) weights of normals.
    """
    b, v, u = wp.tid()
    height = intensity.shape[1]
    width = intensity.shape[2]
    window = (v * windows[0] / height) * windows[1] + u * windows[1] / width

    if only_with_depth == 0 or depth[b, v, u] > 0.0:
        level = wp.clamp(int(intensity[b, v, u] + 0.5), 0, 255)
        wp.atomic_add(intensity_counts, b, window * 256 + level, 1)

    n = wp.vec3(0.0, 0.0, 0.0)
    if use_given_normals != 0:
        n = given_normals[b, v, u]
    else:
        n = depth_normal(depth, b, v, u, focal, centre, radius, edge_threshold)
    if n[0] != 0.0 or n[1] != 0.0 or n[2] != 0.0:
        add_normal(n, b, window * num_normal_bins, size, starts, bins, weights, normal_counts)


@wp.kernel
def compute_normals(
    depth: wp.array3d(dtype=wp.float32),
    focal: wp.vec2,
    centre: wp.vec2,
    radius: int,
    edge_threshold: float,
    normals: wp.array3d(dtype=wp.vec3),
):
    """Unit normals of every pixel, zero where there is none."""
    b, v, u = wp.tid()
    normals[b, v, u] = wp.normalize(
        depth_normal(depth, b, v, u, focal, centre, radius, edge_threshold)
    )
