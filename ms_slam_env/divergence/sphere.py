"""Bins of normal vectors on the unit sphere: equations (6), (7) and (8)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.geometry import Float64

Float32 = NDArray[np.float32]

TABLE_SIZE = 80
"""Cells along one side of the octahedral map of directions."""


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


def cell_directions() -> Float64:
    """Unit vectors (TABLE_SIZE ** 2, 3) at the cell centres of the octahedral map.

    The map has -z at its centre, where the normals that a camera sees are (z forward).
    """
    axis = (np.arange(TABLE_SIZE) + 0.5) * 2 / TABLE_SIZE - 1
    y, x = np.meshgrid(axis, axis, indexing="ij")
    z = np.abs(x) + np.abs(y) - 1
    fold = np.maximum(z, 0)  # the outer four triangles of the square are the folded half z > 0
    directions = np.stack([x - np.sign(x) * fold, y - np.sign(y) * fold, z], axis=-1)
    directions = directions.reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@lru_cache(maxsize=16)
def cell_weights(inclinations: int, alpha_deg: float) -> Float32:
    """Weights (TABLE_SIZE ** 2, L) of (8) at the cell centres, for N and alpha."""
    weights = bin_weights(
        cell_directions(), bin_directions(inclinations), float(np.deg2rad(alpha_deg))
    ).astype(np.float32)
    weights.flags.writeable = False
    return weights


def dither_offsets(height: int, width: int) -> Float32:
    """Offsets (height, width, 2) in [0, 1), evenly spread over any patch of the image.

    Source: the two-dimensional low-discrepancy sequence R2 (Roberts, "The unreasonable
    effectiveness of quasirandom sequences", 2018), its two steps along rows and columns.
    """
    v, u = np.mgrid[:height, :width].astype(np.float64)
    a, b = 0.7548776662466927, 0.5698402909980532
    offsets = np.stack([u * a + v * b, u * b + v * (1 - a)], axis=-1) % 1.0
    return np.minimum(offsets, 0.999999).astype(np.float32)  # float32 could round up to 1
