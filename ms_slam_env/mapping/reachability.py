"""Where a camera can go through space that is known to be free, and how far that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

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


@dataclass(frozen=True)
class Ways:
    """The shortest ways from one place to N others.

    Attributes:
        positions: (N, 3) metres; the first is where the ways begin.
        lengths: (N,) metres of the way to each.
        before: (N,) the position before each on its way; negative for the first.
    """

    positions: Float64
    lengths: Float64
    before: NDArray[np.int32]

    def to(self, end: int) -> Float64:
        """Positions (K, 3) of the way to position ``end``, where it begins the first."""
        indices = [end]
        while self.before[indices[-1]] >= 0:
            indices.append(int(self.before[indices[-1]]))
        return self.positions[indices[::-1]]


def shortest_ways(grid: OccupancyGrid, position: Float64, radius_m: float) -> Ways:
    """Ways (Dijkstra's) from ``position`` (3,) through the cells that `reachable_positions` gives.

    Every other cell along each axis is a node, joined to those of the 26 around it: two cells with
    free neighbours have none but free cells between them. Of the nodes only those that can be come
    to are kept.
    """
    cells = grid.cells_of(reachable_positions(grid, position, radius_m))
    nodes = cells[(cells % 2 == grid.cells_of(position) % 2).all(axis=1)] // 2
    if not len(nodes):
        return Ways(position[None].copy(), np.zeros(1), np.full(1, -1, np.int32))
    low = nodes.min(axis=0) - 1
    index = np.full(nodes.max(axis=0) - low + 2, -1)
    index[tuple((nodes - low).T)] = np.arange(len(nodes))
    around = nodes[None] - low + _HALF_OF_26[:, None]
    others = index[tuple(np.moveaxis(around, -1, 0))]
    step, node = np.nonzero(others >= 0)
    metres = 2 * grid.cell_m * np.linalg.norm(_HALF_OF_26, axis=1)[step]
    edges = metres, (node, others[step, node])
    lengths = sparse.csr_array(edges, shape=(len(nodes), len(nodes)))
    centres = grid.centres_of(2 * nodes + grid.cells_of(position) % 2)
    first = int(np.argmin(((centres - position) ** 2).sum(axis=1)))
    found, before = dijkstra(lengths, directed=False, indices=first, return_predecessors=True)
    order = np.argsort(found, kind="stable")[: np.isfinite(found).sum()]
    place = np.full(len(nodes), -1, np.int32)
    place[order] = np.arange(len(order))
    earlier = np.where(before[order] < 0, -1, place[np.maximum(before[order], 0)])
    return Ways(centres[order], found[order], earlier.astype(np.int32))


_HALF_OF_26 = np.argwhere(np.ones((3, 3, 3)))[14:] - 1
