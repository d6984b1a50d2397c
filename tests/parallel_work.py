"""Work for tests of worker pools; importable by new processes."""

from __future__ import annotations

import os
import warnings
from typing import Any

from tqdm import tqdm

from ms_slam_env.errors import InputError, InputWarning


def work(spec: int) -> dict[str, Any]:
    """Square ``spec``, with a bar; it warns of 7, complains below zero, and 13 ends the process."""
    tqdm([spec], disable=True)
    if spec == 7:
        warnings.warn("7 is prime", InputWarning, stacklevel=1)
    if spec == 13:
        os._exit(3)
    if spec < 0:
        raise (InputError if spec == -1 else ValueError)(f"no square of {spec}\nsecond line")
    return {"square": spec**2, "pid": os.getpid(), "threads": os.environ.get("OMP_NUM_THREADS")}
