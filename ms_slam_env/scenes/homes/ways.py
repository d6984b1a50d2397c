"""Walking routes through a home: the shortest that keep clear of walls and furniture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.free_space import FreeSpace

_CELL_M = 0.1
_COLUMN_M = (1.0, 1.75)  # heights that must be free
_LEAST_M = 0.28  # free space around the walker
_NEAR_M = 0.3  # from the ends of a route to its first and last cell
_EASY_M = 0.6  # a larger clearance is no better
_STEPS = ((1, 0), (0, 1), (1, 1), (1, -1))


class Ways:
    """Shortest routes on a floor grid; cells near an obstacle cost more."""

    def __init__(self, free: FreeSpace, low: Float64, high: Float64) -> None:
        """Build the grid of the floor between two corners (x, y)."""
        axes = [np.arange(low[k], high[k], _CELL_M) for k in (0, 1)]
        x, y = np.meshgrid(*axes, indexing="ij")
        levels = np.arange(*_COLUMN_M, free.voxel_m)
        columns = np.stack(
            [
                free.clearance(np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3))
                for z in levels
            ]
        )
        self._room = columns.min(axis=0).reshape(x.shape)
        self._points = np.stack([x, y], -1).reshape(-1, 2)
        self._graph = self._edges()

    @property
    def widest(self) -> tuple[Float64, NDArray[np.floating]]:
        """Points (N, 2) of the grid and the clearance (N,) of each."""
        return self._points, self._room.ravel()

    def between(self, start: Float64, end: Float64) -> Float64 | None:
        """Route (K, 2) from ``start`` (2,) to ``end`` (2,), both included, or None."""
        first, last = self._nearest(start), self._nearest(end)
        if first is None or last is None:
            return None
        _, before = dijkstra(self._graph, indices=first, return_predecessors=True)
        way = [last]
        while way[-1] != first:
            if before[way[-1]] < 0:
                return None
            way.append(int(before[way[-1]]))
        inner = self._points[way[::-1]][1:-1]
        return np.concatenate([start[None, :2], inner, end[None, :2]])

    def _nearest(self, point: Float64) -> int | None:
        distance = np.linalg.norm(self._points - point[:2], axis=1)
        distance[self._room.ravel() <= _LEAST_M] = np.inf
        nearest = int(np.argmin(distance))
        return nearest if distance[nearest] < _NEAR_M else None

    def _edges(self) -> coo_array:
        nx, ny = self._room.shape
        index = np.arange(nx * ny).reshape(nx, ny)
        is_free = self._room > _LEAST_M
        rows, columns, costs = [], [], []
        for dx, dy in _STEPS:
            here = (slice(0, nx - dx), slice(max(0, -dy), ny - max(0, dy)))
            there = (slice(dx, nx), slice(max(0, dy), ny - max(0, -dy)))
            both = is_free[here] & is_free[there]
            narrow = np.minimum(np.minimum(self._room[here], self._room[there]), _EASY_M)[both]
            rows.append(index[here][both])
            columns.append(index[there][both])
            costs.append(np.hypot(dx, dy) * _CELL_M * (_EASY_M / narrow) ** 2)
        a, b, cost = map(np.concatenate, (rows, columns, costs))
        ends = (np.concatenate([a, b]), np.concatenate([b, a]))
        return coo_array((np.concatenate([cost, cost]), ends), (nx * ny, nx * ny)).tocsr()
