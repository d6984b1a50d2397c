"""Least-squares alignment of two point sets with known correspondence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError

Float64 = NDArray[np.float64]


def umeyama(
    source: Float64, target: Float64, with_scale: bool = False
) -> tuple[Float64, Float64, float]:
    """Rotation R (3, 3), translation t (3,) and scale s minimising |s R source + t - target|^2.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 1991, equations (38) to (43). Points (N, 3) of each set correspond by row.
    On degenerate sets (fewer than 3 points, or all on a line) the answer is one of several best.

    Raises:
        InputError: a scale is asked for and all source points coincide.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_centred, target_centred = source - source_mean, target - target_mean
    covariance = target_centred.T @ source_centred / len(source)  # (38)
    U, singular, Vt = np.linalg.svd(covariance)
    S = np.eye(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        S[2, 2] = -1.0  # (43): the best proper rotation, not a reflection
    R = U @ S @ Vt  # (40)
    scale = 1.0
    if with_scale:
        variance = (source_centred**2).sum() / len(source)
        if variance < 1e-18:
            raise InputError("an alignment with scale needs an estimate that moves")
        scale = float((singular * np.diag(S)).sum() / variance)  # (42)
    return R, target_mean - scale * R @ source_mean, scale  # (41)
