"""Deterministic, area-uniform samples of a triangle mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.base import Float64

_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])  # R2 low-discrepancy sequence


def sample_surface(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], spacing_m: float
) -> tuple[Float64, NDArray[np.int64]]:
    """Points (N, 3), one per ``spacing_m`` squared of area, and the face (N,) each lies on.

    Triangles are walked in order of index, so a point falls on a triangle in exact proportion to
    its area; the place inside it follows the R2 sequence, so points spread evenly.
    """
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    total = np.cumsum(area)
    n = max(1, int(total[-1] / spacing_m**2))
    face = np.searchsorted(total, (np.arange(n) + 0.5) * (total[-1] / n))
    face = np.minimum(face, len(faces) - 1)
    r = np.mod(np.arange(1, n + 1)[:, None] * _PLASTIC, 1.0)
    fold = r.sum(1) > 1.0
    r[fold] = 1.0 - r[fold]
    return corners[face, 0] + r[:, :1] * e1[face] + r[:, 1:] * e2[face], face
