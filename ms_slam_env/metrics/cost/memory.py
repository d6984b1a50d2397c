"""Memory of this process (MEM), as Linux counts it."""

from __future__ import annotations

import ctypes
import gc
import os
from pathlib import Path


def memory_mb(name: str) -> float | None:
    """Figure ``name`` of this process from Linux's status file, megabytes; None elsewhere."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    return None


def resident_mb() -> float | None:
    """Memory in use now, megabytes; the cheap way to the status file's VmRSS. None elsewhere."""
    try:
        with open("/proc/self/statm", "rb") as file:
            pages = int(file.read().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def forget_peak_memory() -> float | None:
    """Let the peak begin anew at what is in use now; return that, megabytes (proc(5)).

    Memory that was freed is handed back first: what is taken from it again would not be counted.
    """
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):  # no Linux, or no glibc
        return None
    return memory_mb("VmRSS")
