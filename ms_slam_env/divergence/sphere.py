"""Bins of normal vectors on the unit sphere: equations (6), (7) and (8)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64

MAP_SIZE = 32
"""Cells per side of the octahedral map of directions; even, so that no fold cuts a cell."""
_ROUNDING_RAD = 1e-3  # upper bound of single-precision errors at cell edges


@lru_cache(maxsize=32)
def bin_directions(inclinations: int) -> Float64:
    """Centres (L, 3) of the bins as unit vectors, equations (6) and (7).

    As printed, i runs from 1 to N: the pole at theta = pi has a bin, but the one at theta = 0 does
    not. In the camera frame (z forward) visible surfaces have normals with z < 0, near the pole
    with a bin.
    """
    N = inclinations
    directions = []
    for i in range(1, N + 1):
        theta = np.pi * i / N  # (6)
        # The small number keeps floor() correct if 2 N sin(theta) is an integer.
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


def octahedral_directions(x: ArrayLike, y: ArrayLike) -> Float64:
    """Unit vectors (..., 3) at points of the octahedral map, x and y (...) in [-1, 1].

    The map has -z at its centre, where the normals that a camera sees are (z forward).
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    z = np.abs(x) + np.abs(y) - 1
    fold = np.maximum(z, 0)  # the four outer triangles of the square are the folded half z > 0
    directions = np.stack([x - np.sign(x) * fold, y - np.sign(y) * fold, z], axis=-1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@lru_cache(maxsize=16)
def bins_near(inclinations: int, alpha_deg: float) -> NDArray[np.int32]:
    """Bins (MAP_SIZE ** 2, 1 + K) that a direction in each cell of the octahedral map may affect.

    Per cell: their number, then their indices. The lists only skip bins whose weight (8) is zero.
    """
    edges = np.linspace(-1, 1, MAP_SIZE + 1)
    corners = octahedral_directions(*np.meshgrid(edges, edges))
    middle = (edges[1:] + edges[:-1]) / 2
    centres = octahedral_directions(*np.meshgrid(middle, middle))
    # Lines on the map are great circles: the farthest point of a cell is one of its corners.
    all_corners = [corners[i : i + MAP_SIZE, j : j + MAP_SIZE] for i in (0, 1) for j in (0, 1)]
    radius = np.max([_angle((c * centres).sum(axis=-1)) for c in all_corners], axis=0).ravel()
    away = _angle(centres.reshape(-1, 3) @ bin_directions(inclinations).T)
    is_near = away < radius[:, None] + np.deg2rad(alpha_deg) + _ROUNDING_RAD
    count = is_near.sum(axis=1)
    lists = np.zeros((len(count), 1 + count.max()), dtype=np.int32)
    lists[:, 0] = count
    for row, near in zip(lists, is_near, strict=True):
        row[1 : 1 + near.sum()] = np.flatnonzero(near)
    lists.flags.writeable = False
    return lists


def _angle(cosine: Float64) -> Float64:
    return np.arccos(np.clip(cosine, -1, 1))
