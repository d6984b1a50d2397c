"""Occupancy around a camera, in its own frame: what an agent can be shown of the map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.mapping.kernels import count_states
from ms_slam_env.mapping.occupancy_grid import OccupancyGrid

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_MOST_SAMPLES = 5


def surrounding_occupancy(
    grid: OccupancyGrid, T_world_camera: Float64, blocks: tuple[int, int, int], block_m: float
) -> Float32:
    """Shares of free and of occupied space in blocks around a camera, (2, X, Y, Z) in [0, 1].

    The rest of a block is unknown. Blocks lie along the camera's axes (x right, y down, z forward),
    as many on either side of it; each is looked at in as many places as leave no cell out, but no
    more than five along an edge.

    Args:
        grid: what is known.
        T_world_camera: (4, 4).
        blocks: X, Y, Z, how many along each axis.
        block_m: edge of a block, metres.
    """
    samples = min(_MOST_SAMPLES, math.ceil(block_m / grid.cell_m - 1e-9))
    corner = -0.5 * block_m * np.array(blocks)
    start = T_world_camera[:3, :3] @ corner + T_world_camera[:3, 3]
    with wp.ScopedDevice("cpu"):
        shares = wp.zeros((2, *blocks), dtype=float)
        given = [
            wp.array(grid.log_odds, dtype=wp.int8, copy=False),
            wp.mat33(*(T_world_camera[:3, :3] * block_m / grid.cell_m).ravel()),
            wp.vec3(*(start / grid.cell_m - grid.first)),
            samples,
        ]
        wp.launch(count_states, blocks, given, [shares])
    return np.asarray(shares.numpy())
