"""Point clouds, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError

Float64 = NDArray[np.float64]


def check_points(points: ArrayLike, name: str) -> Float64:
    """Return points (N, 3) as float64.

    Raises:
        InputError: wrong shape, no points, values that are not finite or not numbers.
    """
    try:
        values = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} is not an array of numbers") from None
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (N, 3), got {values.shape}")
    if len(values) == 0:
        raise InputError(f"{name} is empty")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values
