"""Pixels that one thread of a kernel does: a whole row on the CPU, one on a GPU.

On the CPU a launch runs on one thread, and a loop over a row becomes vector instructions.
"""

from __future__ import annotations

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
