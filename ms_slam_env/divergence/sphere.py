"""Bins of normal vectors on the unit sphere: equations (6), (7) and (8)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

TABLE_SIZE = 192
"""Cells along one side of the octahedral map behind the weight table."""

WEIGHT_SCALE = 4096
"""Weights are summed as integers in units of 1 / WEIGHT_SCALE: the order of summation, which a
GPU does not fix, then does not matter. 640 x 480 pixels of weight 1 still fit into 31 bits."""


@lru_cache(maxsize=32)
def bin_directions(inclinations: int) -> Float64:
    """Centres (L, 3) of the bins as unit vectors, equations (6) and (7).

    As printed, i runs from 1 to N: the pole at theta = pi has a bin, the one at theta = 0 has
    none. In the camera frame (z forward) visible surfaces have normals with z < 0, near the
    pole that has its bin.
    """
    N = inclinations
    directions = []
    for i in range(1, N + 1):
        theta = np.pi * i / N  # (6)
        # The small number keeps floor() right where 2 N sin(theta) is an integer.
        M = int(np.floor(2 * N * np.sin(theta) + 1e-9)) + 1
        for j in range(1, M + 1):
            phi = 2 * np.pi * j / M  # (7)
            directions.append(
                [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
            )
    result = np.array(directions)
    result.flags.writeable = False
    return result


def bin_weights(normals: ArrayLike, directions: ArrayLike, alpha_rad: float) -> Float64:
    """Weights (K, L) of unit normals (K, 3) in the bins (L, 3), equation (8).

    1 at the centre of the bin, falling to 0 at the angle alpha.
    """
    cosine = np.asarray(normals, dtype=np.float64) @ np.asarray(directions, dtype=np.float64).T
    # cosine >= cos(alpha) is arccos(cosine) <= alpha, and the weight is 0 at equality.
    return np.maximum(cosine - np.cos(alpha_rad), 0.0) / (1.0 - np.cos(alpha_rad))


@dataclass(frozen=True)
class WeightTable:
    """Weights of (8) for directions on an octahedral grid, as compressed rows.

    Cell c holds the entries ``starts[c]`` to ``starts[c + 1]`` of ``bins`` and ``weights``.

    Attributes:
        starts: (TABLE_SIZE ** 2 + 1,) int32.
        bins: (E,) int32 bin index.
        weights: (E,) int32, weight times WEIGHT_SCALE.
        num_bins: L.
    """

    starts: Int32
    bins: Int32
    weights: Int32
    num_bins: int


def _cell_directions() -> Float64:
    """Unit vectors (TABLE_SIZE ** 2, 3) at the cell centres of the octahedral map."""
    axis = (np.arange(TABLE_SIZE) + 0.5) * 2 / TABLE_SIZE - 1
    y, x = np.meshgrid(axis, axis, indexing="ij")
    z = 1 - np.abs(x) - np.abs(y)
    # The outer four triangles of the square are the folded lower half (z < 0).
    fold = np.maximum(-z, 0)
    x = x - np.sign(x) * fold
    y = y - np.sign(y) * fold
    directions = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@lru_cache(maxsize=16)
def weight_table(inclinations: int, alpha_deg: float) -> WeightTable:
    """Tabulate (8) for ``inclinations`` N and the influence angle ``alpha_deg``."""
    directions = bin_directions(inclinations)
    weights = bin_weights(_cell_directions(), directions, np.deg2rad(alpha_deg))
    units = np.rint(weights * WEIGHT_SCALE).astype(np.int32)
    cells, bins = np.nonzero(units)
    starts = np.zeros(len(units) + 1, dtype=np.int32)
    np.cumsum(np.bincount(cells, minlength=len(units)), out=starts[1:])
    return WeightTable(starts, bins.astype(np.int32), units[cells, bins], len(directions))
