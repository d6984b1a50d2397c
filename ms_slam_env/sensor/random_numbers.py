"""Counter-based random numbers: a function of (seed, frame index, pixel), of nothing else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ms_slam_env._warp import wp
from ms_slam_env.errors import InputError

NORMAL_STEPS = 65536
"""Entries of the table of the normal distribution's quantiles."""


def normal_table() -> NDArray[np.float32]:
    """Quantiles (65536,) of N(0, 1) at the midpoints; a table costs less than Box and Muller."""
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


_PCG_INCREMENT = wp.constant(wp.uint32(2891336453))


@wp.func
def pcg(x: wp.uint32) -> wp.uint32:
    """Hash of 32 bits: Jarzynski and Olano, "Hash Functions for GPU Rendering", JCGT 2020."""
    state = x * wp.uint32(747796405) + _PCG_INCREMENT
    word = ((state >> ((state >> wp.uint32(28)) + wp.uint32(4))) ^ state) * wp.uint32(277803737)
    return (word >> wp.uint32(22)) ^ word


@wp.func
def pixel_state(key_0: wp.uint32, key_1: wp.uint32, pixel: int) -> wp.uint32:
    """First random word of a pixel; further words follow by ``pcg(state + stream)``."""
    return pcg(pcg(wp.uint32(pixel) ^ key_0) + key_1)


@wp.func
def normal_low(word: wp.uint32, table: wp.array(dtype=wp.float32)) -> float:
    """N(0, 1) from the low 16 bits of a random word."""
    return table[int(word & wp.uint32(65535))]


@wp.func
def normal_high(word: wp.uint32, table: wp.array(dtype=wp.float32)) -> float:
    """N(0, 1) from the high 16 bits of a random word."""
    return table[int(word >> wp.uint32(16))]


@wp.func
def uniform(word: wp.uint32) -> float:
    """Uniform in [0, 1) from the high 24 bits of a random word."""
    return float(word >> wp.uint32(8)) * (1.0 / 16777216.0)
