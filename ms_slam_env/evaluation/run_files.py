"""The files of a run: what every frame cost and how it was aligned (CSV), and the map (PLY)."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.evaluation.run_sequence import SequenceRun
from ms_slam_env.evaluation.tracking_diagnosis import alignment_columns
from ms_slam_env.output_files import write_bytes, write_text

Float64 = NDArray[np.float64]

COSTS = ("frame_cpu_ms", "frame_ext_ms", "frame_mem_mb", "frame_ene_j")
"""Metrics of one frame, as `frame_costs` gives them."""


def frame_costs(run: SequenceRun) -> dict[str, Float64]:
    """What each frame (N,) cost, by key; NaN where it cannot be had.

    The cost of a frame that was interrupted before it was recorded is left out.
    """
    costs = run.costs[: len(run)]
    values = [(1e3 * cost.cpu_s, 1e3 * cost.ext_s, cost.mem_mb, cost.joules) for cost in costs]
    return dict(zip(COSTS, np.array(values, dtype=np.float64).reshape(-1, 4).T, strict=True))


def write_frames(path: Path, run: SequenceRun) -> None:
    """Write as CSV what every frame cost, how it was aligned, and why it was refused.

    What is unknown is empty.
    """
    costs = frame_costs(run)
    columns = {name: costs[f"frame_{name}"] for name in ("ext_ms", "cpu_ms", "mem_mb", "ene_j")}
    columns |= alignment_columns(run)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["timestamp", "tracking_ok", *columns, "reason"])
    for index, (timestamp, result) in enumerate(zip(run.timestamps, run.results, strict=True)):
        values = (_number(name, values[index]) for name, values in columns.items())
        words = [f"{timestamp:.6f}", int(result.tracking_ok), *values, result.reason]
        writer.writerow(words)
    write_text(path, text.getvalue())


def _number(name: str, value: float) -> str:
    digits = {"residual_m": 6, "degenerate_directions": 0}.get(name, 3)
    return "" if math.isnan(value) else f"{value:.{digits}f}"


_PLY_NAMES = {"color": ("red", "green", "blue"), "normal": ("nx", "ny", "nz")}
_PLY_TYPES = {"u1": "uchar", "f4": "float"}


def write_ply(
    path: Path, points: NDArray[np.float64], attributes: dict[str, NDArray[np.generic]]
) -> None:
    """Write points (M, 3) and what is known of each, by name: (M,) or (M, 3) arrays, binary PLY.

    ``color`` is uint8, everything else 32-bit floats.
    """
    columns = {name: np.asarray(points[:, k], "<f4") for k, name in enumerate("xyz")}
    for name, values in attributes.items():
        kind = "u1" if name == "color" else "<f4"
        for k, column in enumerate(np.atleast_2d(values.T)):
            columns[_PLY_NAMES.get(name, (name,))[k]] = column.astype(kind)
    table = np.empty(len(points), dtype=[(name, c.dtype) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {_PLY_TYPES[c.dtype.str[1:]]} {name}" for name, c in columns.items()),
        "end_header",
    ]
    write_bytes(path, "\n".join(lines).encode() + b"\n" + table.tobytes())
