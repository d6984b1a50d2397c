# ruff: noqa: UP018, RUF046
# Warp code: int(0) declares a variable that changes.
"""Kernels that render surfels: cull, z-buffer of discs, average of the front surface, resolve.

Two passes over the visible discs: the first finds the nearest surface of every pixel, the second
averages all discs within the depth tolerance behind it (the visibility splatting of Botsch et al.,
"High-quality surface splatting on today's GPUs", 2005). The inverse depth of a disc's plane is
linear in the image, so the depth at a pixel is that of the viewing ray's intersection with the
plane, at the cost of two multiplications; z-buffers hold inverse depth, 0 where empty.

Launches are (envs, workers): the workers of an env share its list, and the CPU's single worker
keeps the camera in registers. Image buffers are flat, which saves most of their address
arithmetic.
"""

# mypy: disable-error-code="empty-body"

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.blocks import BLOCK, Blocks, Frustum, frustum_of
from ms_slam_env.slam.surfel.discs import Discs, SplatCamera, floor_int
from ms_slam_env.slam.surfel.memory import fetch, put, raise_to
from ms_slam_env.slam.surfel.surfel_arrays import SeenWindow, Surfels, VisibleList, depth_tolerance

BLOCK_SIZE = wp.constant(BLOCK)
Sums = wp.types.vector(length=8, dtype=wp.float32)
"""Weighted sums of a pixel: normal (3), weight, colour (3), depth."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
constexpr int LANES = 1;  // surfels at a time
#else
constexpr int LANES = 64;
#endif
const int n = end - first < LANES ? end - first : LANES;
const size_t start = size_t(b) * surfels.radius.shape[1] + first;
const float* positions = (const float*)surfels.position.data + 3 * start;
const float* normals = (const float*)surfels.normal.data + 3 * start;
const float* confidence = surfels.confidence.data + start;
const int* seen = surfels.seen.data + start;
const wp::mat33 R = frustum.R;
const wp::vec3 t = frustum.t;
float x[LANES], y[LANES], z[LANES];
int inside[LANES];
int found = 0;
for (int k = 0; k < n; ++k) {
    const float px = positions[3 * k], py = positions[3 * k + 1], pz = positions[3 * k + 2];
    x[k] = R.data[0][0] * px + R.data[0][1] * py + R.data[0][2] * pz + t[0];
    y[k] = R.data[1][0] * px + R.data[1][1] * py + R.data[1][2] * pz + t[1];
    z[k] = R.data[2][0] * px + R.data[2][1] * py + R.data[2][2] * pz + t[2];
    inside[k] = (z[k] > frustum.z_near) & (z[k] < frustum.z_far)
        & (x[k] > frustum.low_u * z[k]) & (x[k] < frustum.high_u * z[k])
        & (y[k] > frustum.low_v * z[k]) & (y[k] < frustum.high_v * z[k])
        & (confidence[k] > 0.0f) & (seen[k] >= seen_from) & (seen[k] <= seen_to);
    found += inside[k];
}
if (found == 0) return n;
float nx[LANES], ny[LANES], nz[LANES];
for (int k = 0; k < n; ++k) {
    const float px = normals[3 * k], py = normals[3 * k + 1], pz = normals[3 * k + 2];
    nx[k] = R.data[0][0] * px + R.data[0][1] * py + R.data[0][2] * pz;
    ny[k] = R.data[1][0] * px + R.data[1][1] * py + R.data[1][2] * pz;
    nz[k] = R.data[2][0] * px + R.data[2][1] * py + R.data[2][2] * pz;
    inside[k] &= nx[k] * x[k] + ny[k] * y[k] + nz[k] * z[k] < 0.0f;
}
int which[LANES];
found = 0;
for (int k = 0; k < n; ++k) {
    which[found] = k;
    found += inside[k];
}
const size_t place = size_t(row) * visible.index.shape[1]
    + wp::atomic_add(visible.count.data + row, found);
for (int m = 0; m < found; ++m) {
    const int k = which[m];
    visible.index.data[place + m] = first + k;
    visible.position.data[place + m] = wp::vec3(x[k], y[k], z[k]);
    visible.normal.data[place + m] = wp::vec3(nx[k], ny[k], nz[k]);
    visible.radius.data[place + m] = surfels.radius.data[start + k];
}
return n;
""")
def list_some(
    surfels: Surfels,
    b: int,
    first: int,
    end: int,
    frustum: Frustum,
    seen_from: int,
    seen_to: int,
    row: int,
    visible: VisibleList,
) -> int:
    """List the visible ones of the surfels from ``first`` on; how many were looked at.

    Several at a time on the CPU, at most to ``end``; a thread of a GPU looks at one.
    """


@wp.kernel
def cull(
    surfels: Surfels,
    blocks: Blocks,
    first_env: int,
    poses: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    margin_px: float,
    workers: int,
    window: SeenWindow,
    visible: VisibleList,
) -> None:
    """List the living surfels of a window in front of the camera, facing it, within its frustum.

    Those of the blocks that ``list_blocks`` listed; ``poses[k]`` is T_world_camera of env
    ``first_env + k``. A single worker, as on the CPU, keeps the order of the map.
    """
    k, worker = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    count = surfels.count[b]
    seen_from = window.seen_from[b]
    seen_to = window.seen_to[b]
    slots = blocks.num_listed[k] * BLOCK_SIZE
    j = int(worker)
    while j < slots:
        block = j / BLOCK_SIZE
        i = blocks.listed[k, block] * BLOCK_SIZE + j - block * BLOCK_SIZE
        looked_at = 1
        if i < count:
            end = wp.min((i / BLOCK_SIZE + 1) * BLOCK_SIZE, count)
            end = wp.where(workers == 1, end, i + 1)
            looked_at = list_some(surfels, b, i, end, frustum, seen_from, seen_to, k, visible)
        j += wp.where(workers == 1, looked_at, workers)


@wp.func
def squared_offset(x: float, y: float, z: float, inverse_offset: float) -> float:
    """Squared distance (m2) from the centre of a disc at depth z of a point of its plane.

    The point is x, y (m) and an inverse depth away from the centre. To first order in the offset:
    only the disc's rim moves, by less than its perspective.
    """
    away = z * z * inverse_offset
    return x * x + y * y + away * away


@wp.kernel
def splat_depth(
    visible: VisibleList,
    camera: SplatCamera,
    workers: int,
    discs: Discs,
    z_buffer: wp.array(dtype=wp.float32),
) -> None:
    """Inverse depth (E * H * W) of the nearest disc at every pixel; list the discs on a pixel."""
    k, worker = wp.tid()
    width = camera.width
    image = k * camera.height * width
    count = visible.count[k]
    j = int(worker)
    while j < count:
        left = fetch(discs.left, k, j)
        right = fetch(discs.right, k, j)
        row = fetch(discs.top, k, j)
        bottom = fetch(discs.bottom, k, j)
        if left <= right and row <= bottom:
            centre_u = fetch(discs.u, k, j)
            centre_v = fetch(discs.v, k, j)
            centre_inverse = fetch(discs.inverse, k, j)
            slope_u = fetch(discs.slope_u, k, j)
            slope_v = fetch(discs.slope_v, k, j)
            rim = fetch(discs.rim, k, j)
            nearly_rim = rim * 1.00001  # ``splat_attributes`` rounds otherwise
            hits = int(0)
            z = 1.0 / centre_inverse
            pixel_u = z / camera.focal[0]
            pixel_v = z / camera.focal[1]
            while row <= bottom:
                dv = float(row) - centre_v
                u = int(left)
                while u <= right:
                    du = float(u) - centre_u
                    offset = du * slope_u + dv * slope_v
                    squared = squared_offset(du * pixel_u, dv * pixel_v, z, offset)
                    hits += wp.where(squared <= nearly_rim, 1, 0)
                    inverse = wp.where(squared <= rim, centre_inverse + offset, 0.0)
                    raise_to(z_buffer, image + row * width + u, inverse)
                    u += 1
                row += 1
            if hits > 0:
                put(discs.drawn, k, wp.atomic_add(discs.num_drawn, k, 1), j)
        j += workers


@wp.kernel
def splat_attributes(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: SplatCamera,
    workers: int,
    discs: Discs,
    z_buffer: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=Sums),
) -> None:
    """Sum the discs of the front surface at every pixel.

    The weight is the confidence, at most ``max_weight``, falling off towards the disc's rim.
    """
    k, worker = wp.tid()
    b = first_env + k
    width = camera.width
    image = k * camera.height * width
    count = discs.num_drawn[k]
    d = int(worker)
    while d < count:
        j = fetch(discs.drawn, k, d)
        left = fetch(discs.left, k, j)
        right = fetch(discs.right, k, j)
        row = fetch(discs.top, k, j)
        bottom = fetch(discs.bottom, k, j)
        centre_u = fetch(discs.u, k, j)
        centre_v = fetch(discs.v, k, j)
        centre_inverse = fetch(discs.inverse, k, j)
        slope_u = fetch(discs.slope_u, k, j)
        slope_v = fetch(discs.slope_v, k, j)
        per_rim = 1.0 / fetch(discs.rim, k, j)
        n = fetch(visible.normal, k, j)
        i = fetch(visible.index, k, j)
        color = fetch(surfels.color, b, i)
        confidence = wp.min(fetch(surfels.confidence, b, i), camera.max_weight)
        z = 1.0 / centre_inverse
        pixel_u = z / camera.focal[0]
        pixel_v = z / camera.focal[1]
        # Same surface: z < front + tolerance. To first order in inverse depth.
        reach = depth_tolerance(camera.tolerance_m, z) * centre_inverse * centre_inverse
        while row <= bottom:
            dv = float(row) - centre_v
            u = int(left)
            while u <= right:
                du = float(u) - centre_u
                offset = du * slope_u + dv * slope_v
                inverse = centre_inverse + offset
                share = squared_offset(du * pixel_u, dv * pixel_v, z, offset) * per_rim
                pixel = image + row * width + u
                if share <= 1.0 and inverse >= fetch(z_buffer, pixel) - reach:
                    w = confidence * (1.05 - share)
                    sample = Sums(
                        n[0], n[1], n[2], 1.0, color[0], color[1], color[2], 1.0 / inverse
                    )
                    wp.atomic_add(sums, pixel, w * sample)
                u += 1
            row += 1
        d += workers


@wp.kernel
def list_hidden(
    visible: VisibleList,
    camera: SplatCamera,
    workers: int,
    z_buffer: wp.array(dtype=wp.float32),
    hidden: VisibleList,
) -> None:
    """List the visible surfels well behind the front surface at their own pixel."""
    k, worker = wp.tid()
    image = k * camera.height * camera.width
    for j in range(worker, visible.count[k], workers):
        p = visible.position[k, j]
        u = floor_int(camera.focal[0] * p[0] / p[2] + camera.centre[0] + 0.5)
        v = floor_int(camera.focal[1] * p[1] / p[2] + camera.centre[1] + 0.5)
        if u >= 0 and u < camera.width and v >= 0 and v < camera.height:
            inverse = z_buffer[image + v * camera.width + u]
            if inverse > 0.0:
                front = 1.0 / inverse
                if p[2] > front + 2.0 * depth_tolerance(camera.tolerance_m, front):
                    slot = wp.atomic_add(hidden.count, k, 1)
                    hidden.index[k, slot] = visible.index[k, j]
                    hidden.position[k, slot] = p
                    hidden.normal[k, slot] = visible.normal[k, j]
                    hidden.radius[k, slot] = visible.radius[k, j]


@wp.func
def luma(color: wp.vec3) -> float:
    """ITU-R BT.601 luma."""
    return 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]


@wp.kernel
def resolve(
    sums: wp.array(dtype=Sums),
    camera: SplatCamera,
    vertices: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    intensity: wp.array(dtype=wp.float32),
    color: wp.array(dtype=wp.vec3),
) -> None:
    """Divide the sums by their weights; pixels that no disc covers become 0."""
    k, v = wp.tid()
    row = (k * camera.height + v) * camera.width
    y = (float(v) - camera.centre[1]) / camera.focal[1]
    per_column = 1.0 / camera.focal[0]
    for u in range(camera.width):
        s = sums[row + u]
        vertex = wp.vec3(0.0, 0.0, 0.0)
        normal = wp.vec3(0.0, 0.0, 0.0)
        mean = wp.vec3(0.0, 0.0, 0.0)
        if s[3] > 0.0:
            scale = 1.0 / s[3]
            z = s[7] * scale
            vertex = wp.vec3(z * (float(u) - camera.centre[0]) * per_column, z * y, z)
            normal = wp.normalize(wp.vec3(s[0], s[1], s[2]))
            mean = wp.vec3(s[4], s[5], s[6]) * scale
        vertices[row + u] = vertex
        normals[row + u] = normal
        color[row + u] = mean
        intensity[row + u] = luma(mean)
