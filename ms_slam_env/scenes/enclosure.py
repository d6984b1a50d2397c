"""Finds the inside of a mesh that may have holes, no ceiling, or separate pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env.scenes.base import Float64
from ms_slam_env.scenes.rays import RayCaster

_COARSE_M = 0.2
_SHARE = 0.8


def _directions() -> Float64:
    """17 directions to the sides and down: many scans and models have no ceiling."""
    grid = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0)])
    grid = grid[np.abs(grid).sum(1) > 0].astype(np.float64)
    return grid / np.linalg.norm(grid, axis=1, keepdims=True)


@dataclass(frozen=True)
class Enclosed:
    """The largest connected component of empty voxels that see surface in most directions.

    A voxel is enclosed if at least 80 % of 17 rays, sideways and downwards, hit the mesh. If none
    is (an object seen from outside), the largest component of all empty voxels is taken.
    """

    rays: RayCaster

    def __call__(
        self, empty: NDArray[np.bool_], origin: Float64, voxel_m: float
    ) -> NDArray[np.bool_]:
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
        # A coarse cell at a wall may have its centre beyond it; walls themselves still separate.
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
