"""Tables that compare SLAM systems: every sequence, medians, paired differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.statistics import median_interval, share_interval
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table, summary

METRICS = (
    *("ate_m", "ate_tracked_m", "tracked_share", "ate_max_m", "ate_unaligned_m"),
    *("rpe_m", "rpe_rad", "lost_share"),
    *("map_error_median_m", "f_score_2cm"),
    *("cpu_ms_mean", "cpu_ms_median", "cpu_ms_p95", "ext_ms_median"),
    *("mem_peak_mb", "ene_frame_j", "ene_model_frame_j"),
)
PAIRED = ("ate_m", "ate_tracked_m", "rpe_m", "tracked_share", "f_score_2cm", "cpu_ms_median")
"""Metrics for which differences from the reference are reported."""
MEDIAN = "median"
_LONGEST = 100  # characters shown of a reason

Cell = Mapping[str, Any]


def comparison_tables(rows: Sequence[Row], reference: str) -> list[Table]:
    """Tabulate, per image size, the sequences with medians, then differences from ``reference``."""
    cells = cells_of(rows)
    tables = []
    for size in dict.fromkeys(cell["image_size"] for cell in cells):
        own = [cell for cell in cells if cell["image_size"] == size]
        tables.append(make_table(_columns(own), [*own, *medians(own)], size, _note(own)))
        differences = _differences(own, reference)
        tables += [differences] if differences else []
    return tables


def groups_of(rows: Sequence[Row]) -> list[list[Row]]:
    """Group the rows that repeat one image size, sequence and system."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        key = tuple(row["spec"][name] for name in ("image_size", "sequence", "backend"))
        groups.setdefault(key, []).append(row)
    return list(groups.values())


def cells_of(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return one cell for each image size, sequence and system."""
    shown = distinct_names([row["spec"]["sequence"] for row in rows])
    return [_cell_of(group, shown) for group in groups_of(rows)]


def distinct_names(sequences: Sequence[str]) -> dict[str, str]:
    """Name sequences; a folder by the shortest end of its path that tells it apart."""
    paths = {text: Path(text).parts if "/" in text else (text,) for text in sequences}
    names: dict[str, str] = {}
    for text, parts in paths.items():
        others = [other for name, other in paths.items() if name != text]
        for count in range(1, len(parts) + 1):
            if all(other[-count:] != parts[-count:] for other in others):
                break
        names[text] = "/".join(parts[-count:])
    return names


def _cell_of(repeats: Sequence[Row], shown: Mapping[str, str]) -> dict[str, Any]:
    """Return the medians over repeats; the first error if all failed."""
    spec = repeats[0]["spec"]
    cell: dict[str, Any] = {
        "image_size": spec["image_size"],
        "sequence": shown[spec["sequence"]],
        "backend": spec["backend"],
    }
    results = [row["result"] for row in finished(repeats)]
    if not results:
        return {**cell, "error": repeats[0]["error"]}
    known = {key: [r[key] for r in results if r.get(key) is not None] for key in METRICS}
    return {**cell, **{key: float(np.median(values)) for key, values in known.items() if values}}


def medians(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return a line per system: medians with intervals over the sequences that it finished."""
    lines = []
    for backend, own in _finished(cells).items():
        known = {key: summary(own, key) for key in METRICS if any(key in cell for cell in own)}
        count = {"sequences_count": len(own)}
        lines.append({"sequence": MEDIAN, "backend": backend, **count, **known})
    return lines


def _finished(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """Group the cells of finished sequences by system; empty for one that failed on all."""
    found: dict[str, list[Cell]] = {cell["backend"]: [] for cell in cells}
    for cell in cells:
        if "error" not in cell:
            found[cell["backend"]].append(cell)
    return found


def failures(cells: Sequence[Cell]) -> dict[str, list[str]]:
    """List, for each system that failed, the sequences that it did not finish, and why."""
    found: dict[str, list[str]] = {}
    for cell in cells:
        if "error" in cell:
            why = f"{cell['sequence']}: {cell['error']}"
            shown = why if len(why) <= _LONGEST else f"{why[: _LONGEST - 3]}..."
            found.setdefault(cell["backend"], []).append(shown)
    return found


def _columns(cells: Sequence[Cell]) -> list[str]:
    """Return the columns of a table, without metrics and errors that no cell has."""
    shown = [key for key in (*METRICS, "error") if any(key in cell for cell in cells)]
    return ["sequence", "backend", "sequences_count", *shown]


def _note(cells: Sequence[Cell]) -> str:
    """Say what the medians cover: which system failed where and why, which metrics have gaps."""
    total, finished_by = len({cell["sequence"] for cell in cells}), _finished(cells)
    note = f"{MEDIAN.capitalize()}: over the sequences that a backend finished, of {total}"
    note += "".join(
        f"; {backend} over {len(finished_by[backend])}, not {', '.join(reasons)}"
        for backend, reasons in failures(cells).items()
    )
    fewer = [
        f"{backend}'s {metric(key).heading} over {known}"
        for backend, own in finished_by.items()
        for key in METRICS
        if 0 < (known := sum(key in cell for cell in own)) < len(own)
    ]
    note += f"; {', '.join(fewer)}" if fewer else ""
    return f"{note}. With 95 % bootstrap intervals over the sequences."


def _differences(cells: Sequence[Cell], reference: str) -> Table | None:
    """Tabulate each system's differences from the reference, and how often it is better.

    Only sequences that both finished count. None if no system shares one with the reference.
    """
    by_system = {
        backend: {cell["sequence"]: cell for cell in own}
        for backend, own in _finished(cells).items()
    }
    base = by_system.pop(reference, {})
    shared = {backend: [(own[at], base[at]) for at in own if at in base]
              for backend, own in by_system.items()}  # fmt: skip
    lines = [_line(backend, pairs) for backend, pairs in shared.items() if pairs]
    if not lines:
        return None
    shown = [key for key in PAIRED if any(f"{key}_more" in line for line in lines)]
    columns = [Column(f"{key}_more", key, f"{metric(key).heading}, difference") for key in shown]
    title = f"{cells[0]['image_size']}: differences from {reference}"
    note = (
        f"Medians of the differences on the sequences that {reference} finished, too, with 95 % "
        "bootstrap intervals: where an interval contains 0, chance may have made the difference. "
        "Better on: share of the sequences with a smaller ATE."
    )
    return make_table(["backend", "sequences_count", *columns, "better_share"], lines, title, note)


def _line(backend: str, pairs: Sequence[tuple[Cell, Cell]]) -> dict[str, Any]:
    line: dict[str, Any] = {"backend": backend, "sequences_count": len(pairs)}
    for key in PAIRED:
        more = [a[key] - b[key] for a, b in pairs if key in a and key in b]
        if more:
            line[f"{key}_more"] = median_interval(more)
    wins = [a["ate_m"] < b["ate_m"] for a, b in pairs]
    return {**line, "better_share": share_interval(wins)}
