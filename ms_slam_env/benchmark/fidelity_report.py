"""Table and figure of the fidelity benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark.figures import caption, colour, new_figure, save
from ms_slam_env.report.statistics import Interval, median_interval
from ms_slam_env.report.tables import format_interval, format_number, markdown_table

KINDS = ("intensity", "depth")
TARGETS = (0.7, 0.8)


@dataclass(frozen=True)
class Line:
    """One setting over all states; pairs are (intensity, depth).

    Attributes:
        setting: its name.
        states: how many.
        correlation: median Spearman correlation with its interval.
        floor: median divergence of two frames from one pose.
        median: median over states of the median divergence over the candidates.
    """

    setting: str
    states: int
    correlation: tuple[Interval, Interval]
    floor: tuple[float, float]
    median: tuple[float, float]


def summarise(settings: Sequence[str], results: Sequence[dict[str, Any]]) -> list[Line]:
    """One line a setting, over the states of all paths."""
    lines = []
    for setting in settings:
        states = [state for result in results for state in result["settings"][setting]]
        if not states:
            continue
        correlation = np.array([state["correlation"] for state in states])
        floor = np.median([state["floor"] for state in states], axis=0)
        median = np.median([state["median"] for state in states], axis=0)
        lines.append(
            Line(
                setting=setting,
                states=len(states),
                correlation=(
                    median_interval(correlation[:, 0]),
                    median_interval(correlation[:, 1]),
                ),
                floor=(float(floor[0]), float(floor[1])),
                median=(float(median[0]), float(median[1])),
            )
        )
    return lines


def as_table(lines: Sequence[Line]) -> str:
    """Markdown table, one line a setting."""
    header = ["setting"]
    for kind in KINDS:
        header += [f"{kind}: rank correlation", f"{kind}: floor", f"{kind}: median met"]
    rows = []
    for line in lines:
        cells = [line.setting]
        for k in range(len(KINDS)):
            cells += [
                format_interval(line.correlation[k]),
                format_number(line.floor[k]),
                format_number(line.median[k]),
            ]
        rows.append(cells)
    states = lines[0].states if lines else 0
    return f"{states} states\n\n" + markdown_table(header, rows)


def save_figure(lines: Sequence[Line], path: Path) -> None:
    """Draw the correlations of every setting with their intervals; dashed: what was aimed at."""
    figure = new_figure(2, width=5.0, height=0.6 + 0.28 * max(len(lines), 1))
    panels = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(lines))[::-1]
    for k, (panel, kind) in enumerate(zip(panels, KINDS, strict=True)):
        intervals = [line.correlation[k] for line in lines]
        panel.hlines(rows, [i.low for i in intervals], [i.high for i in intervals], color=colour(k))
        panel.plot([i.value for i in intervals], rows, "o", color=colour(k), markersize=5)
        panel.axvline(TARGETS[k], color="grey", linestyle="--", linewidth=1)
        panel.set_title(f"{kind}: rank correlation")
        panel.set_xlim(0, 1)
        panel.grid(alpha=0.3)
    panels[0].set_yticks(rows, [line.setting for line in lines])
    caption(figure, "Dot and bar: median over states and its 95 % interval; dashed: the aim.")
    save(figure, path)
