"""Work for tests of worker pools; importable by new processes."""

from __future__ import annotations

import os
from typing import Any

from tqdm import tqdm

from ms_slam_env.errors import InputError


def work(spec: int) -> dict[str, Any]:
    """Square ``spec``, with a bar; below zero it complains, 13 kills the process."""
    tqdm([spec], disable=True)
    if spec == 13:
        os._exit(3)
    if spec < 0:
        raise (InputError if spec == -1 else ValueError)(f"no square of {spec}\nsecond line")
    return {"square": spec**2, "pid": os.getpid(), "threads": os.environ.get("OMP_NUM_THREADS")}
