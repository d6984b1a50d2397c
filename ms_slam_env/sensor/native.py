"""Shared parts of the sensor's native kernels: compiler flags, spans, random keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ms_slam_env.errors import InputError

VECTOR_FLAGS = {"cpu_compiler_flags": "-march=native"}
"""Module options that let native loops vectorise; Warp's default flags prevent it."""


def span_of(width: int, device: str) -> int:
    """Number of pixels that one thread processes in a row of ``width`` pixels."""
    return width if device == "cpu" else 1


NORMAL_STEPS = 65536
"""Number of entries in the table of normal quantiles."""


def normal_table() -> NDArray[np.float32]:
    """Quantiles (65536,) of N(0, 1) at midpoints; a table is cheaper than Box-Muller."""
    return ndtri((np.arange(NORMAL_STEPS) + 0.5) / NORMAL_STEPS).astype(np.float32)


def frame_key(seed: int, index: int) -> NDArray[np.uint32]:
    """Key (2,) uint32 of frame ``index`` under ``seed``.

    Raises:
        InputError: a seed or an index that is not an integer >= 0.
    """
    for name, value in (("seed", seed), ("index", index)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
            raise InputError(f"sensor {name} must be an integer >= 0, got {value!r}")
    return np.random.SeedSequence([int(seed), int(index)]).generate_state(2).astype(np.uint32)
