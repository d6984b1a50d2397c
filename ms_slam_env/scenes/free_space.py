"""Free space for a camera: a grid of distances to the surface, 0 inside objects and outside."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env._runtime.arrays import Bool, Float32, Float64
from ms_slam_env.scenes.mesh_queries import RayCaster

VOXEL_M = 0.05
_GRID_ERROR = 0.4  # of a voxel
_MAX_CELLS = 6_000_000

ComponentRule = Callable[[Bool, Float64, float], Bool]
"""Selects the free voxels (nx, ny, nz), given the empty ones, their origin (3,) and edge."""


@dataclass(frozen=True)
class Holding:
    """The connected components of empty voxels that contain the points ``inside`` (K, 3)."""

    inside: Float64

    def __call__(self, empty: Bool, origin: Float64, voxel_m: float) -> Bool:
        """See ``ComponentRule``."""
        component, _ = ndimage.label(empty)
        seeds = np.rint((np.atleast_2d(self.inside) - origin) / voxel_m).astype(int)
        seeds = np.clip(seeds, 0, np.array(empty.shape) - 1)
        wanted = np.unique(component[tuple(seeds.T)])
        return np.isin(component, wanted[wanted > 0])


def trilinear(values: NDArray[np.floating], f: Float64) -> Float64:
    """Trilinear interpolation at f (N, 3) in [0, 1] of corner values (N, 2, 2, 2)."""
    along_x = values[:, 0] + (values[:, 1] - values[:, 0]) * f[:, 0, None, None]
    along_y = along_x[:, 0] + (along_x[:, 1] - along_x[:, 0]) * f[:, 1, None]
    return along_y[:, 0] + (along_y[:, 1] - along_y[:, 0]) * f[:, 2]


def voxel_for(low: Float64, high: Float64, voxel_m: float = VOXEL_M) -> float:
    """Voxel edge for a box with corners (3,): ``voxel_m``, or more if the box is large."""
    volume = float(np.prod(high - low + 4 * voxel_m))
    return max(voxel_m, (volume / _MAX_CELLS) ** (1 / 3))


class FreeSpace:
    """Distance to the nearest surface on a voxel grid, interpolated trilinearly.

    The surface in a voxel is represented by the mean of its samples, so the distance may err by
    almost a voxel if the surface in the nearest voxel is curved.

    Attributes:
        origin: (3,) centre of the first voxel, metres.
        voxel_m: edge of a voxel.
        distance: (nx, ny, nz) float32 metres from the voxel's centre to the surface; 0 where the
            voxel is not in the free component.
    """

    def __init__(self, points: Float64, rule: ComponentRule, voxel_m: float = VOXEL_M) -> None:
        """Build the grid.

        Args:
            points: (N, 3) samples of the surface, closer together than ``voxel_m``.
            rule: selects the free voxels among the empty ones.
            voxel_m: edge of a voxel; increased if the grid would not fit in memory.
        """
        low, high = points.min(0), points.max(0)
        self.voxel_m = voxel_for(low, high, voxel_m)
        self.origin = low - 1.5 * self.voxel_m
        shape = tuple(np.ceil((high - low) / self.voxel_m).astype(int) + 4)
        index = np.rint((points - self.origin) / self.voxel_m).astype(np.int64)
        flat = np.ravel_multi_index(tuple(index.T), shape)
        # The mean surface point per occupied voxel gives distances finer than a voxel.
        count = np.bincount(flat, minlength=int(np.prod(shape)))
        occupied = count > 0
        cells = np.flatnonzero(occupied)
        total = np.stack(
            [np.bincount(flat, points[:, k], minlength=len(count))[cells] for k in range(3)], -1
        )
        mean = total / count[cells, None]
        slot = np.zeros(len(count), dtype=np.int32)
        slot[cells] = np.arange(len(cells))
        empty = ~occupied.reshape(shape)
        nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
        nearest_flat = np.ravel_multi_index(tuple(nearest), shape)
        surface = mean[slot[nearest_flat]]  # (nx, ny, nz, 3)
        axes = [self.origin[k] + self.voxel_m * np.arange(shape[k]) for k in range(3)]
        square = sum(
            (surface[..., k] - np.expand_dims(axes[k], [j for j in range(3) if j != k])) ** 2
            for k in range(3)
        )
        free = rule(empty, self.origin, self.voxel_m)
        self._take(np.where(free, np.sqrt(square), 0.0).astype(np.float32))

    @classmethod
    def of_grid(cls, distance: Float32, origin: Float64, voxel_m: float) -> FreeSpace:
        """Make a free space from attributes computed earlier."""
        space = cls.__new__(cls)
        space.origin, space.voxel_m = origin, voxel_m
        space._take(distance)
        return space

    def _take(self, distance: Float32) -> None:
        self.distance = distance
        _, ny, nz = distance.shape
        self._limit = np.array(distance.shape) - 1.001
        corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        self._corner_offset = corner @ np.array([ny * nz, nz, 1])
        self._stride = np.array([ny * nz, nz, 1])
        self._flat = self.distance.ravel()

    def clearance(self, points: Float64) -> Float64:
        """Distance (N,) from points (N, 3) to the nearest surface, 0 inside objects or outside."""
        position = (
            np.asarray(points, dtype=np.float64).reshape(-1, 3) - self.origin
        ) / self.voxel_m
        clipped = np.clip(position, 0.0, self._limit)
        base = clipped.astype(np.int64)
        f = clipped - base
        values = self._flat[(base @ self._stride)[:, None] + self._corner_offset]  # (N, 8)
        result = trilinear(values.reshape(-1, 2, 2, 2), f)
        return np.where((position == clipped).all(1), result, 0.0)

    def segments_are_free(self, start: Float64, ends: Float64, radius_m: float) -> Bool:
        """Whether (N,) a ball can move freely from ``start`` (3,) to each of ``ends`` (N, 3).

        The distance to the surface changes by at most the distance travelled, so samples ``step``
        apart need a clearance of ``radius_m`` + step / 2, plus part of a voxel for the grid's
        error. The result errs on the side of False.
        """
        a = np.asarray(start, dtype=np.float64)
        ways = np.asarray(ends, dtype=np.float64) - a
        lengths = [math.sqrt(way.dot(way)) for way in ways]
        steps = [max(1, math.ceil(length / (0.4 * self.voxel_m))) for length in lengths]
        samples = [a + _shares(count) * way for count, way in zip(steps, ways, strict=True)]
        slack = [
            0.5 * length / count + _GRID_ERROR * self.voxel_m
            for length, count in zip(lengths, steps, strict=True)
        ]
        counts = [count + 1 for count in steps]
        needed = np.repeat(radius_m + np.array(slack), counts)
        is_free = self.clearance(np.concatenate(samples)) > needed
        return np.logical_and.reduceat(is_free, np.cumsum([0, *counts[:-1]]))


@lru_cache(maxsize=256)
def _shares(steps: int) -> Float64:
    """Fractions (steps + 1, 1) of a segment at which it is sampled."""
    return np.linspace(0.0, 1.0, steps + 1)[:, None]


_COARSE_M = 0.2
_SHARE = 0.8


def _directions() -> Float64:
    """17 sideways and downward directions: many scans and models have no ceiling."""
    grid = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0)])
    grid = grid[np.abs(grid).sum(1) > 0].astype(np.float64)
    return grid / np.linalg.norm(grid, axis=1, keepdims=True)


@dataclass(frozen=True)
class Enclosed:
    """The largest connected component of empty voxels that see surface in most directions.

    A voxel is enclosed if at least 80 % of 17 rays, sideways and downwards, hit the mesh. If none
    is (an object seen from outside), the largest component of all empty voxels is used.
    """

    rays: RayCaster

    def __call__(self, empty: Bool, origin: Float64, voxel_m: float) -> Bool:
        """See ``ComponentRule``."""
        step = max(1, round(_COARSE_M / voxel_m))
        index = np.stack(
            np.meshgrid(*(np.arange(step // 2, n, step) for n in empty.shape), indexing="ij"), -1
        )
        centres = (origin + voxel_m * index).reshape(-1, 3)
        hits = np.zeros(len(centres))
        directions = _directions()
        for direction in directions:
            distance, _ = self.rays.first_hit(centres, np.broadcast_to(direction, centres.shape))
            hits += np.isfinite(distance)
        coarse = (hits >= _SHARE * len(directions)).reshape(index.shape[:3])
        # The centre of a coarse cell at a wall may be beyond it; walls themselves still separate.
        coarse = ndimage.binary_dilation(coarse, iterations=1)
        nearest = [
            np.minimum(np.arange(n) // step, m - 1)
            for n, m in zip(empty.shape, coarse.shape, strict=True)
        ]
        enclosed = empty & coarse[np.ix_(*nearest)]
        component, count = ndimage.label(enclosed if enclosed.any() else empty)
        if count == 0:
            return np.zeros_like(empty)
        sizes = np.bincount(component.ravel())
        sizes[0] = 0
        return component == int(np.argmax(sizes))
