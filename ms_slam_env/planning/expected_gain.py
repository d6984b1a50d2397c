"""Predict how much unknown space a camera would see from a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.planning.kernels import BLOCK, sum_unknown, sum_unknown_held
from ms_slam_env.planning.occupancy_grid import OccupancyGrid

RAYS = (16, 12)  # of a view, across and down


def expected_gain(
    grid: OccupancyGrid,
    poses: Float64,
    intrinsics: Intrinsics,
    rays: tuple[int, int] = RAYS,
) -> Float64:
    """Unknown volume (N,) in m^3 that cameras at ``poses`` (N, 4, 4) would see.

    The sum over ``rays`` (across, down) and over depths z from 0.3 m to the grid's reach of

        z^2 dz / (f_x f_y) * 0.85^u * 0.7^b   for each unknown cell in front of the first occupied,

    where 1 / (f_x f_y), times the pixels per ray, is the area of a ray on the plane at 1 m, u
    counts the unknown cells (in depth) already passed, and b the frames in which the cell was in
    view without a reading, so that an open door beyond the reach loses its gain.
    """
    return look_from(grid, poses, intrinsics, rays)[0]


def look_from(
    grid: OccupancyGrid, poses: Float64, intrinsics: Intrinsics, rays: tuple[int, int]
) -> tuple[Float64, NDArray[np.float32]]:
    """`expected_gain` (N,), and depths (N, rays), metres, of the first occupied cells; 0: none."""
    directions, solid_angle = spread_rays(intrinsics, rays)
    starts = poses[:, :3, 3] / grid.cell_m - grid.first
    with wp.ScopedDevice("cpu"):
        gains, depths = (wp.zeros((len(poses), len(directions)), dtype=float) for _ in range(2))
        given = [
            wp.array(directions, dtype=wp.vec3),
            wp.array((poses[:, :3, :3] / grid.cell_m).astype(np.float32), dtype=wp.mat33),
            wp.array(starts.astype(np.float32), dtype=wp.vec3),
            wp.array(grid.log_odds, dtype=wp.int8, copy=False),
            wp.array(grid.blanks, dtype=wp.int8, copy=False),
            grid.cell_m,
            grid.reach_m,
        ]
        wp.launch(sum_unknown, gains.shape, given, [gains, depths])
    gain = solid_angle * gains.numpy().sum(axis=1, dtype=np.float64)
    return gain, depths.numpy()


def held_gain(
    grid: OccupancyGrid,
    here: Float64,
    motions: Float64,
    steps: int,
    intrinsics: Intrinsics,
    rays: tuple[int, int] = (8, 6),
) -> Float64:
    """Unknown volume (n, steps) in m^3 that each step of a repeated motion reveals.

    As `expected_gain` of every pose on the way, but blocks of two cells count only in the first
    step that sees them. The gain is 0 once the camera would leave known free space.

    Args:
        grid: the known occupancy.
        here: (4, 4) current pose.
        motions: (n, 4, 4) motions to repeat.
        steps: number of repetitions.
        intrinsics: of the camera.
        rays: of a view, across and down.
    """
    way = held_ways(here, motions, steps)
    directions, solid_angle = spread_rays(intrinsics, rays)
    starts = way[:, :, :3, 3] / grid.cell_m - grid.first
    reach = grid.reach_m / grid.cell_m * np.linalg.norm(directions, axis=1).max()
    low = np.floor((starts.min(axis=(0, 1)) - reach + grid.first) / BLOCK) * BLOCK - grid.first
    blocks = np.ceil((starts.max(axis=(0, 1)) + reach - low) / BLOCK).astype(int)
    with wp.ScopedDevice("cpu"):
        first_seen = wp.zeros((len(motions), *blocks), dtype=wp.int8)
        gains = wp.zeros((len(motions), steps), dtype=float)
        given = [
            wp.array(directions, dtype=wp.vec3),
            wp.array((way[:, :, :3, :3] / grid.cell_m).astype(np.float32), dtype=wp.mat33),
            wp.array(starts.astype(np.float32), dtype=wp.vec3),
            wp.array(grid.log_odds, dtype=wp.int8, copy=False),
            wp.array(grid.blanks, dtype=wp.int8, copy=False),
            grid.cell_m,
            grid.reach_m,
            wp.vec3(*low),
        ]
        wp.launch(sum_unknown_held, len(motions), given, [first_seen, gains])
    return solid_angle * gains.numpy().astype(np.float64)


def held_ways(here: Float64, motions: Float64, steps: int) -> Float64:
    """Poses (n, steps, 4, 4) after each repetition of motions (n, 4, 4)."""
    poses = [here @ motions]
    while len(poses) < steps:
        poses.append(poses[-1] @ motions)
    return np.stack(poses, axis=1)


def spread_rays(intrinsics: Intrinsics, rays: tuple[int, int]) -> tuple[NDArray[np.float32], float]:
    """Rays (N, 3) at depth 1 m, ``rays`` across and down an image, and the solid angle of each."""
    across, down = rays
    u = (np.arange(across) + 0.5) / across * intrinsics.width - 0.5
    v = (np.arange(down) + 0.5) / down * intrinsics.height - 0.5
    directions = intrinsics.rays_at(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)
    pixels_a_ray = intrinsics.width * intrinsics.height / (across * down)
    return directions.astype(np.float32), pixels_a_ray / (intrinsics.fx * intrinsics.fy)
