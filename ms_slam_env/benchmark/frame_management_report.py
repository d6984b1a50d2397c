"""Frame management against regular skipping, as a table and as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark import figures
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import format_number, markdown_table

Cell = dict[str, Any]

MEASURES = (
    *("processed", "lost", "failed", "ate_m", "ate_processed_m", "f_2cm", "f_5cm"),
    *("cpu_ms", "filter_ms"),
)
_SHARES = ("lost", "failed")  # summarised by the mean, all others by the median
_COLUMNS = (
    ("processed", "processed [%]", 100, 3),
    ("ate_m", "ATE all [mm]", 1e3, 3),
    ("ate_processed_m", "ATE processed [mm]", 1e3, 3),
    ("f_2cm", "F-score 2 cm [%]", 100, 3),
    ("failed", "astray [%]", 100, 2),
    ("cpu_ms", "processor [ms]", 1, 2),
    ("filter_ms", "of it the filter [ms]", 1, 2),
)
_PAIRED = ("ate_m", "ate_processed_m", "f_2cm")
_PANELS = (
    ("ate_m", "ATE, all frames [mm]", 1e3),
    ("ate_processed_m", "ATE, processed frames [mm]", 1e3),
    ("f_2cm", "F-score at 2 cm [%]", 100),
    ("cpu_ms", "processor time [ms a frame]", 1),
)


def flat_runs(rows: Sequence[Row]) -> list[Cell]:
    """One flat mapping a run: ``sequence``, ``management``, ``kind`` and its measures.

    ``kind`` is the name of the filter; ``matched`` of the regular skipping beside a filter, which
    has that one's ``management``.
    """
    found = []
    for row in rows:
        if row["error"] is not None:
            continue
        sequence = sequence_label(row["spec"]["sequence"])
        for run in row["result"]["runs"]:
            own = {k: v for k, v in run.items() if k not in ("regular", "management")}
            about = {"sequence": sequence, "management": run["management"]}
            found.append({**about, "kind": run["management"].partition(",")[0], **own})
            if run["regular"] is not None:
                found.append({**about, "kind": "matched", **run["regular"]})
    return found


def sequence_label(text: str) -> str:
    """``scene:seed`` as it is, of a folder the last part."""
    return Path(text).name if "/" in text else text


def summarise(runs: Sequence[Cell]) -> list[Cell]:
    """One cell for each management, over the sequences: medians, and means of shares.

    ``better_ate`` and so on count the sequences on which a filter beats regular skipping of as many
    frames, ``sequences`` all of them; ``regular_ate_m`` and so on are those of regular skipping.
    """
    cells = []
    for management in dict.fromkeys(run["management"] for run in runs):
        own = [r for r in runs if r["management"] == management and r["kind"] != "matched"]
        cell: Cell = {"management": management, "sequences": len(own)}
        cell.update((name, _middle(own, name)) for name in MEASURES)
        matched = [r for r in runs if r["management"] == management and r["kind"] == "matched"]
        if matched:
            cell.update((f"regular_{name}", _middle(matched, name)) for name in MEASURES)
            for name in _PAIRED:
                sign = 1 if name.startswith("f_") else -1
                wins = [sign * (a[name] - b[name]) > 0 for a, b in zip(own, matched, strict=True)]
                cell[f"better_{name}"] = int(sum(wins))
        cells.append(cell)
    return cells


def _middle(runs: Sequence[Cell], name: str) -> float:
    values = [run[name] for run in runs]
    return float(np.mean(values) if name in _SHARES else np.median(values))


def table(summary: Sequence[Cell]) -> str:
    """Markdown: one line a management, then the filters beside regular skipping at equal share."""
    header = ["frame management", *(heading for _, heading, _, _ in _COLUMNS)]
    body = [
        [cell["management"], *(format_number(cell[n] * s, d) for n, _, s, d in _COLUMNS)]
        for cell in summary
    ]
    pairs = [
        "filter (regular skipping at its share)",
        "ATE all [mm]",
        "better on",
        "ATE processed [mm]",
        "better on",
        "F-score 2 cm [%]",
        "better on",
        "astray [%]",
        "processor [ms]",
    ]
    lines = [_pair_line(cell) for cell in summary if "regular_ate_m" in cell]
    count = max((cell["sequences"] for cell in summary), default=0)
    return (
        f"Medians over {count} sequences; astray: share of the sequences in which a processed "
        "frame was more than 0.3 m off.\n\n"
        f"{markdown_table(header, body)}\n"
        "Each filter and, in brackets, regular skipping of as many frames of the same sequence:\n\n"
        f"{markdown_table(pairs, lines)}"
    )


def _pair_line(cell: Cell) -> list[str]:
    line = [cell["management"]]
    for name, scale in (("ate_m", 1e3), ("ate_processed_m", 1e3), ("f_2cm", 100)):
        line.append(_pair(cell, name, scale))
        line.append(f"{cell[f'better_{name}']} of {cell['sequences']}")
    return [*line, _pair(cell, "failed", 100), _pair(cell, "cpu_ms", 1)]


def _pair(cell: Cell, name: str, scale: float) -> str:
    own, regular = cell[name] * scale, cell[f"regular_{name}"] * scale
    return f"{format_number(own, 3)} ({format_number(regular, 3)})"


def save_figure(runs: Sequence[Cell], path: Path) -> Path:
    """Error, map and time against the share of frames processed; a dot a run, a line the medians.

    Regular skipping is drawn as it was run for itself.
    """
    kinds = [k for k in ("regular", "divergence", "budget") if any(r["kind"] == k for r in runs)]
    everything = [run for run in runs if run["kind"] == "none"]
    figure = figures.new_figure(len(_PANELS), height=3.6)
    axes = figure.subplots(1, len(_PANELS))
    for ax, (name, heading, scale) in zip(axes, _PANELS, strict=True):
        for index, kind in enumerate(kinds):
            own = [run for run in runs if run["kind"] == kind]
            colour = figures.colour(index)
            ax.plot(
                [100 * run["processed"] for run in own],
                [scale * run[name] for run in own],
                ".",
                color=colour,
                alpha=0.3,
                markersize=5,
            )
            groups = [
                [run for run in own if run["management"] == management]
                for management in dict.fromkeys(run["management"] for run in own)
            ]
            points = sorted((_middle(g, "processed"), _middle(g, name)) for g in groups)
            x, y = np.array(points).T
            ax.plot(100 * x, scale * y, "o-", color=colour, label=kind, markersize=4)
        if everything:
            whole = scale * _middle(everything, name)
            ax.axhline(whole, color="grey", linestyle=":", label="every frame")
        if name.startswith("ate"):
            ax.set_yscale("log")
            figures.plain_log_ticks(ax.yaxis)
        ax.set(xlabel="frames processed [%]", ylabel=heading)
        ax.grid(alpha=0.3)
    figures.legend_beside(figure, axes[0])
    return figures.save(figure, path)
