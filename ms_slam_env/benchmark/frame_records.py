"""What every frame of a run cost, and whether it was tracked, as CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.metrics import FrameCost

FRAMES = "frames.csv"
_HEADER = ("timestamp", "tracking_ok", "ext_ms", "cpu_ms", "mem_mb", "ene_j")


def write_frames(
    path: Path, times: Sequence[float], tracking_ok: Sequence[bool], costs: Sequence[FrameCost]
) -> None:
    """Write one line a frame; a figure that cannot be had stays empty.

    Costs of a frame that was interrupted before it was recorded are left out.
    """
    lines = [",".join(_HEADER)]
    for timestamp, ok, cost in zip(times, tracking_ok, costs, strict=False):
        values = (1e3 * cost.ext_s, 1e3 * cost.cpu_s, cost.mem_mb, cost.joules)
        words = ["" if math.isnan(value) else f"{value:.3f}" for value in values]
        lines.append(",".join([f"{timestamp:.6f}", str(int(ok)), *words]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def lost_times(path: Path) -> NDArray[np.float64]:
    """Timestamps (K,) of the frames that were not tracked.

    Raises:
        InputError: a file that cannot be read, or that `write_frames` did not write; the message
            names file and line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read frames {path}: {error}") from None
    reader = csv.DictReader(text.splitlines())
    if not set(_HEADER[:2]) <= set(reader.fieldnames or ()):
        raise InputError(f"{path}, line 1: expected columns {', '.join(_HEADER[:2])}")
    lost = []
    for row in reader:
        try:
            timestamp, ok = float(row["timestamp"]), {"0": False, "1": True}[row["tracking_ok"]]
        except (TypeError, ValueError, KeyError):
            raise InputError(
                f"{path}, line {reader.line_num}: expected a timestamp and tracking_ok 0 or 1"
            ) from None
        if not ok:
            lost.append(timestamp)
    return np.array(lost)
