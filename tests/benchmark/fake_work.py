"""Work that needs no environment, for tests of the runner; importable by spawned processes."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.rows import run_all


@dataclass(frozen=True)
class Square:
    """Square ``number`` after ``seconds``; a negative number fails, 1313 kills its process."""

    number: int
    seconds: float = 0.0
    log: str = ""


@dataclass(frozen=True)
class Named(Square):
    """The same, of a planner."""

    planner: str = ""


def square(spec: Square) -> dict[str, Any]:
    if spec.number == 1313:
        os._exit(3)
    if spec.number < 0:
        raise ValueError(f"no square of {spec.number}\nsecond line")
    time.sleep(spec.seconds)
    if spec.log:
        with Path(spec.log).open("a") as file:
            file.write(f"{spec.number}\n")
    return {"square": spec.number**2, "threads": os.environ.get("OMP_NUM_THREADS")}


if __name__ == "__main__":
    out, count, seconds = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    run_all([Square(i, seconds, sys.argv[4]) for i in range(count)], square, out, workers=2)
