"""The comparison of SLAM backends as tables and as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark import figures
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import format_number, markdown_table

Cell = dict[str, Any]

MEDIAN = "median"
_COLUMNS = (
    ("ate_m", "ATE [mm]", 1e3, 3),
    ("ate_max_m", "largest [mm]", 1e3, 3),
    ("ate_unaligned_m", "ATE unaligned [mm]", 1e3, 3),
    ("rpe_m", "RPE [mm]", 1e3, 2),
    ("rpe_rad", "RPE [deg]", 180 / np.pi, 2),
    ("lost", "frames lost [%]", 100, 2),
    ("map_error_mm", "map error [mm]", 1, 2),
    ("f_2cm", "F-score 2 cm [%]", 100, 3),
    ("cpu_ms", "processor [ms]", 1, 3),
    ("cpu_ms_p95", "95 % [ms]", 1, 3),
    ("ms", "clock [ms]", 1, 3),
    ("memory_mb", "memory [MB]", 1, 3),
)
_ENERGY = ("ene_frame_j", "energy [J]", 1, 3)  # a column only where a machine counts it


def backend_label(spec: dict[str, Any]) -> str:
    """Name and parameters of the backend of a run's specification."""
    return ",".join([spec["backend"], *(f"{k}={v}" for k, v in spec["params"].items())])


def sequence_label(text: str) -> str:
    """``scene:seed:noise`` as it is, of a folder the last part."""
    return Path(text).name if "/" in text else text


def summarise(rows: Sequence[Row]) -> list[Cell]:
    """One cell for each image size, sequence and backend, medians over repeats; failures too."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        spec = row["spec"]
        key = (spec["image_size"], sequence_label(spec["sequence"]), backend_label(spec))
        groups.setdefault(key, []).append(row)
    cells = []
    for (size, sequence, backend), group in groups.items():
        results = [row["result"] for row in group if row["error"] is None]
        errors = [row["error"] for row in group if row["error"] is not None]
        cell: Cell = {"image_size": size, "sequence": sequence, "backend": backend}
        cell["error"] = None if results else errors[0]
        for name in results[0] if results else ():
            values = [result[name] for result in results if result.get(name) is not None]
            if values and isinstance(values[0], str):
                cell[name] = values[0]
            else:
                cell[name] = float(np.median(values)) if values else None
        cells.append(cell)
    return cells


def tables(summary: Sequence[Cell]) -> str:
    """A table for each image size: one row a sequence and backend, then medians over sequences.

    In the medians a backend is judged by the sequences that every backend finished.
    """
    parts = []
    for size in dict.fromkeys(cell["image_size"] for cell in summary):
        cells = [cell for cell in summary if cell["image_size"] == size]
        parts.append(f"### {size}\n")
        columns = _columns(cells)
        body = [_line(cell, columns) for cell in (*cells, *medians(cells))]
        header = ["sequence", "backend", *(heading for _, heading, _, _ in columns)]
        parts.append(markdown_table(header, body))
        failed = [cell for cell in cells if cell["error"] is not None]
        parts += [f"- {c['backend']} on {c['sequence']} failed: {c['error']}" for c in failed]
    return "\n".join(parts)


def medians(cells: Sequence[Cell]) -> list[Cell]:
    """Medians over the sequences that every backend finished, one cell a backend."""
    backends = list(dict.fromkeys(cell["backend"] for cell in cells))
    failed = {cell["sequence"] for cell in cells if cell["error"] is not None}
    found = []
    for backend in backends:
        own = [c for c in cells if c["backend"] == backend and c["sequence"] not in failed]
        if not own:
            continue
        median: Cell = {"sequence": MEDIAN, "backend": backend, "error": None}
        for name, *_ in _columns(cells):
            values = [cell[name] for cell in own if cell.get(name) is not None]
            median[name] = float(np.median(values)) if values else None
        found.append(median)
    return found


def save_figure(summary: Sequence[Cell], path: Path) -> Path:
    """Error against processor time, a panel for each image size, a mark for each sequence."""
    sizes = list(dict.fromkeys(cell["image_size"] for cell in summary))
    backends = list(dict.fromkeys(cell["backend"] for cell in summary))
    figure = figures.new_figure(len(sizes), 3.8)
    axes = figure.subplots(1, len(sizes), squeeze=False, sharey=True)[0]
    for ax, size in zip(axes, sizes, strict=True):
        done = [c for c in summary if c["image_size"] == size and c["error"] is None]
        for index, backend in enumerate(backends):
            own = [cell for cell in done if cell["backend"] == backend]
            ax.scatter(
                [cell["cpu_ms"] for cell in own],
                [1e3 * cell["ate_m"] for cell in own],
                color=figures.colour(index),
                label=backend,
                s=14,
            )
        ax.set(xscale="log", yscale="log", xlabel="processor time [ms a frame]", title=size)
        ax.grid(alpha=0.3, which="both")
        for axis in (ax.xaxis, ax.yaxis):
            figures.plain_log_ticks(axis)
    axes[0].set_ylabel("ATE [mm]")
    figures.legend_beside(figure, axes[0])
    return figures.save(figure, path)


def _columns(cells: Sequence[Cell]) -> tuple[tuple[str, str, float, int], ...]:
    counted = any(cell.get(_ENERGY[0]) is not None for cell in cells)
    return (*_COLUMNS, _ENERGY) if counted else _COLUMNS


def _line(cell: Cell, columns: Sequence[tuple[str, str, float, int]]) -> list[str]:
    if cell["error"] is not None:
        return [cell["sequence"], cell["backend"], *["failed"] * len(columns)]
    values = [
        "-" if cell.get(name) is None else format_number(cell[name] * scale, digits)
        for name, _, scale, digits in columns
    ]
    return [cell["sequence"], cell["backend"], *values]
