"""Timestamps of two streams that belong together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def associate(times: Float64, others: Float64, max_difference_s: float) -> tuple[Int64, Int64]:
    """Pairs of indices of timestamps that are each other's nearest, in order.

    Args:
        times: (N,) increasing, seconds.
        others: (M,) increasing, seconds.
        max_difference_s: largest difference within a pair.
    """
    if not max_difference_s >= 0:
        raise InputError(f"max_difference_s = {max_difference_s} must be >= 0")
    nearest = _nearest(times, others)
    mutual = _nearest(others, times)[nearest] == np.arange(len(times))
    close = np.abs(times - others[nearest]) <= max_difference_s
    first = np.flatnonzero(mutual & close)
    return first, nearest[first]


def _nearest(times: Float64, others: Float64) -> Int64:
    """Index (N,) of the one of ``others`` (M,) nearest to each of ``times`` (N,)."""
    right = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    left = right - 1
    right = np.minimum(right, len(others) - 1)
    return np.where(times - others[left] <= others[right] - times, left, right).astype(np.int64)
