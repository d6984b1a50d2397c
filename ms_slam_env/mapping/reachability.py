"""Where a camera can go through space that is known to be free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env.mapping.occupancy_grid import OccupancyGrid

Float64 = NDArray[np.float64]

_NEIGHBOURS = ndimage.generate_binary_structure(3, 1)


def reachable_positions(grid: OccupancyGrid, position: Float64, radius_m: float) -> Float64:
    """Centres (N, 3), metres, of the cells that a camera at ``position`` (3,) can get to.

    Free cells within a cube of half edge ``radius_m`` whose six neighbours are free too, joined to
    the one nearest to ``position``. Empty if there is none.
    """
    here = grid.cells_of(position)
    reach = int(radius_m / grid.cell_m)
    low = np.maximum(here - reach, 0)
    high = np.maximum(np.minimum(here + reach + 1, grid.log_odds.shape), low)
    free = grid.log_odds[tuple(map(slice, low, high))] < 0
    regions, _ = ndimage.label(ndimage.binary_erosion(free, _NEIGHBOURS), _NEIGHBOURS)
    inside = np.argwhere(regions > 0)
    if not len(inside):
        return np.zeros((0, 3))
    nearest = inside[np.argmin(((inside + low - here) ** 2).sum(axis=1))]
    return grid.centres_of(np.argwhere(regions == regions[tuple(nearest)]) + low)
