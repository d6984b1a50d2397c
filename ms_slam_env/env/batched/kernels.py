# mypy: disable-error-code="empty-body"
"""Kernels over B environments: possible motions, grey values, coarse depth, mapped surface.

On a CPU each gives what the environment of one camera computes with NumPy, bit for bit but for the
order of sums in ``coarse_depth``.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.env.coverage import VoxelGrid
from ms_slam_env.native import native_source
from ms_slam_env.sensor.native import VECTOR_FLAGS
from ms_slam_env.sensor.rays import Hits

wp.set_module_options(VECTOR_FLAGS)


@wp.struct
class Place:
    """What is known of the truth of a scene."""

    distance: wp.array3d[wp.float32]  # free space; see `FreeSpace`
    low: wp.vec3d  # centre of its first voxel
    edge_m: wp.float64
    voxels: VoxelGrid  # of the surface
    reachable: wp.array[wp.uint8]  # (voxels,)


@wp.func_native(native_source("batched_steps", "way_is_free"))
def way_is_free(
    distance: wp.array3d[wp.float32],
    low: wp.vec3d,
    edge: wp.float64,
    start: wp.vec3d,
    end: wp.vec3d,
    radius: wp.float64,
) -> int:
    """Whether a ball can move freely from ``start`` to ``end``."""


@wp.kernel
def find_free_ways(
    places: wp.array[Place],  # (B,)
    T_world_camera: wp.array[wp.mat44d],  # (B,)
    ways: wp.array[wp.vec3d],  # (T,) in the camera frame, each along one axis
    radius: wp.float64,
    free: wp.array2d[wp.uint8],  # (B, T)
) -> None:
    """Whether the camera's bounding ball can make each translation."""
    b, t = wp.tid()
    T = T_world_camera[b]
    way = ways[t]
    start = wp.vec3d(T[0, 3], T[1, 3], T[2, 3])
    end = start
    for k in range(3):
        if way[k] != wp.float64(0.0):
            end = start + way[k] * wp.vec3d(T[0, k], T[1, k], T[2, k])
    place = places[b]
    is_free = 1
    if wp.length_sq(way) > wp.float64(0.0):
        is_free = way_is_free(place.distance, place.low, place.edge_m, start, end, radius)
    free[b, t] = wp.uint8(is_free)


@wp.func_native(native_source("batched_steps", "grey_level"))
def grey_level(r: int, g: int, b: int) -> float:
    """Grey level of a colour."""


@wp.kernel
def find_grey(
    color: wp.array4d[wp.uint8],  # (B, H, W, 3)
    levels_a_bin: int,
    grey: wp.array3d[wp.float32],  # (B, H, W)
    histogram: wp.array2d[wp.int32],  # (B, bins), zeros
) -> None:
    """Grey values of a row of pixels, counted in bins."""
    b, y = wp.tid()
    for x in range(color.shape[2]):
        level = grey_level(int(color[b, y, x, 0]), int(color[b, y, x, 1]), int(color[b, y, x, 2]))
        grey[b, y, x] = level
        wp.atomic_add(histogram, b, int(level) / levels_a_bin, 1)


@wp.kernel
def find_coarse_depth(
    depth: wp.array3d[wp.float32],  # (B, H, W)
    rows: int,
    columns: int,
    scale_m: float,
    most: float,
    coarse: wp.array2d[wp.float32],  # (B, 2 * rows * columns)
) -> None:
    """Mean valid depth of a cell, in units of ``scale_m``, and its share of valid pixels."""
    b, cell = wp.tid()
    height = depth.shape[1]
    width = depth.shape[2]
    row = cell / columns
    column = cell % columns
    first_x = column * width / columns
    first_y = row * height / rows
    end_x = (column + 1) * width / columns
    end_y = (row + 1) * height / rows
    total = wp.float32(0.0)
    count = wp.float32(0.0)
    for y in range(first_y, end_y):
        for x in range(first_x, end_x):
            z = depth[b, y, x]
            if z > 0.0:
                total += z
                count += 1.0
    coarse[b, cell] = wp.min(total / wp.max(count, 1.0) / scale_m, most)
    coarse[b, rows * columns + cell] = count / float((end_x - first_x) * (end_y - first_y))


@wp.func_native(native_source("coverage", "voxel_seen"))
def voxel_seen(
    z: wp.float64,
    rays: wp.array[wp.float64],
    i: int,
    T_true: wp.mat44d,
    T_estimate: wp.mat44d,
    grid: VoxelGrid,
) -> wp.int64:
    """Voxel that a point is mapped in, in its true place; -1 if there is none."""


@wp.kernel
def mark_seen(
    places: wp.array[Place],  # (B,)
    depth: wp.array3d[wp.float32],  # (B, H, W) readings; 0 = none
    hits: Hits,  # of B * H * W rays
    stride: int,
    rays: wp.array[wp.float64],  # (3 N,) points at depth 1 m of every ``stride``-th pixel
    T_world_camera: wp.array[wp.mat44d],  # (B,)
    T_world_camera_estimate: wp.array[wp.mat44d],  # (B,)
    fused: wp.array[wp.int32],  # (B,)
    mapped: wp.array2d[wp.uint32],  # (B, words), a bit for each voxel, in and out
    counts: wp.array2d[wp.int32],  # (B, 2) voxels mapped, and of those reachable; in and out
) -> None:
    """Mark the true voxels of points that the estimate puts within a voxel."""
    b, i = wp.tid()
    if fused[b] == 0:
        return
    columns = (depth.shape[2] + stride - 1) / stride
    y = i / columns * stride
    x = i % columns * stride
    pixel = (b * depth.shape[1] + y) * depth.shape[2] + x
    if depth[b, y, x] <= 0.0 or hits.face[pixel] < 0 or hits.t[pixel] <= 0.0:
        return
    place = places[b]
    z = wp.float64(hits.t[pixel])
    poses = T_world_camera[b], T_world_camera_estimate[b]
    voxel = voxel_seen(z, rays, i, poses[0], poses[1], place.voxels)
    if voxel < wp.int64(0):
        return
    bit = wp.uint32(1) << wp.uint32(voxel % wp.int64(32))
    word = wp.int32(voxel / wp.int64(32))
    if (wp.atomic_or(mapped, b, word, bit) & bit) == wp.uint32(0):
        wp.atomic_add(counts, b, 0, 1)
        wp.atomic_add(counts, b, 1, wp.int32(place.reachable[wp.int32(voxel)]))
