"""What native kernels share: vector loops over a row, and random numbers that need no state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ms_slam_env.errors import InputError

VECTORISE = """
#if defined(__clang__) && !defined(__CUDA_ARCH__)
#pragma clang loop vectorize(assume_safety) vectorize_width(8) interleave(disable)
#endif
"""
"""Put before a loop in native code whose turns are independent: eight at a time."""

VECTOR_FLAGS = {"cpu_compiler_flags": "-march=native"}
"""Options of a module with such loops: under Warp's default flags Clang does not vectorise them."""


def span_of(width: int, device: str) -> int:
    """Pixels a thread does of a row of ``width`` pixels."""
    return width if device == "cpu" else 1


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


PCG = """
auto pcg = [](unsigned x) {
    const unsigned state = x * 747796405u + 2891336453u;
    const unsigned word = ((state >> ((state >> 28) + 4u)) ^ state) * 277803737u;
    return (word >> 22) ^ word;
};
auto first_word = [&](int pixel) { return pcg(pcg((unsigned)pixel ^ key_0) + key_1); };
"""
"""C++: a hash of 32 bits, and the first random word of a pixel under the frame's key.

Further words follow by ``pcg(word + stream)``. The low and the high 16 bits of a word each index
``normal_table``. Source: Jarzynski and Olano, "Hash Functions for GPU Rendering", JCGT 2020.
"""
