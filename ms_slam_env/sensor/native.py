"""Shared parts of the sensor's native kernels: compiler flags, spans, random keys."""

from __future__ import annotations

from collections.abc import Callable

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


_WORDS = 4  # of NumPy's entropy pool
_MULTIPLIERS = {"in": (0x43B0D7E5, 0x931E8875), "out": (0x8B51F9DD, 0x58F38DED)}
_MIX = 0xCA01F9DD, 0x4973F715


def frame_keys(seeds: NDArray[np.integer], indices: NDArray[np.integer]) -> NDArray[np.uint32]:
    """`frame_key` of frames ``indices`` (B,) under ``seeds`` (B,), both below 2**32: (B, 2).

    ``SeedSequence`` as in NumPy's bit_generator.pyx, of two words of entropy, for all at once.
    """
    word = np.uint32

    def hashes(kind: str) -> Callable[[NDArray[np.uint32]], NDArray[np.uint32]]:
        constant, factor = _MULTIPLIERS[kind]

        def scramble(value: NDArray[np.uint32]) -> NDArray[np.uint32]:
            nonlocal constant
            value = value ^ word(constant)
            constant = constant * factor & 0xFFFFFFFF
            value = value * word(constant)
            return value ^ value >> word(16)

        return scramble

    scramble = hashes("in")
    nothing = np.zeros(len(seeds), dtype=word)
    entropy = [np.asarray(seeds).astype(word), np.asarray(indices).astype(word), nothing, nothing]
    pool = [scramble(values) for values in entropy]
    for source in range(_WORDS):
        for target in range(_WORDS):
            if source != target:
                mixed = pool[target] * word(_MIX[0]) - scramble(pool[source]) * word(_MIX[1])
                pool[target] = mixed ^ mixed >> word(16)
    scramble = hashes("out")
    return np.stack([scramble(pool[0]), scramble(pool[1])], axis=1)
