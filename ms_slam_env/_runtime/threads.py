"""How many threads and cores a process may use."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMEXPR")
THREAD_VARIABLES = tuple(f"{library}_NUM_THREADS" for library in _LIBRARIES)
"""Environment variables from which libraries read, when loaded, how many threads to start."""

_HAS_AFFINITY = hasattr(os, "sched_setaffinity")


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if _HAS_AFFINITY else os.cpu_count() or 1


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that limit libraries loaded later to ``threads`` threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))


def one_thread_unless_set() -> dict[str, str]:
    """The variables of `thread_environment` for one thread, except those set by the user."""
    return {name: one for name, one in thread_environment(1).items() if name not in os.environ}


def limit_threads(threads: int) -> None:
    """Limit this process to ``threads`` cores, whatever its libraries choose.

    Libraries loaded later read the environment variables, OpenCV is told directly, and pools that
    ignore both (TBB) obey the CPU affinity.
    """
    import cv2

    os.environ.update(thread_environment(threads))
    cv2.setNumThreads(threads)
    if _HAS_AFFINITY:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


@contextmanager
def limited_threads(threads: int | None) -> Iterator[None]:
    """Limit the enclosed work to ``threads`` cores; None changes nothing.

    OpenCV is told directly; threads that other libraries already started obey the CPU affinity.
    """
    if threads is None or not _HAS_AFFINITY:
        yield
        return
    import cv2

    before, cores = cv2.getNumThreads(), os.sched_getaffinity(0)
    cv2.setNumThreads(threads)
    _set_affinity(sorted(cores)[:threads])
    try:
        yield
    finally:
        _set_affinity(cores)
        cv2.setNumThreads(before)


def _set_affinity(cores: Collection[int]) -> None:
    """Restrict every thread of this process to ``cores``."""
    for task in Path("/proc/self/task").glob("*"):
        with contextlib.suppress(ProcessLookupError):  # it has ended
            os.sched_setaffinity(int(task.name), cores)
