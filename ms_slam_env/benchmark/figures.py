"""Figures of the planner benchmark."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from ms_slam_env.benchmark.planner_report import Column, finished, summarise
from ms_slam_env.report.records import Row

PANELS = (
    Column("f_score_5cm", "F-score at 5 cm [%]", 100),
    Column("rcm", "completeness at 5 cm [%]", 100),
    Column("ate_m", "ATE [mm]", 1000),
    Column("path_length_m", "path length [m]"),
)
_FLOOR_MM = 0.05  # errors below are drawn here on logarithmic axes
_OWN_COLOURS = ("greedy", "random", "max-information", "stationary", "policy", "policy-features")


def save_planner_figures(rows: Sequence[Row], out: Path) -> list[Path]:
    """Draw every figure into folder ``out``; return their paths."""
    out.mkdir(parents=True, exist_ok=True)
    done = finished(rows)
    if not done:
        return []
    figures = {
        "planners.png": planners_figure(done),
        "f_score_ate.png": scatter_figure(done),
        "ate_over_time.png": ate_over_time_figure(done),
    }
    return [save(figure, out / name) for name, figure in figures.items()]


def new_figure(columns: int = 1, width: float = 3.4, height: float = 3.2) -> Figure:
    """An empty figure for ``columns`` panels; needs no display."""
    return Figure(figsize=(width * columns, height), layout="constrained")


def caption(figure: Figure, text: str) -> None:
    """Say above the panels what the marks are."""
    figure.suptitle(text, x=0.01, horizontalalignment="left", fontsize="small")


def legend_beside(figure: Figure, ax: Axes) -> None:
    """Put the legend of ``ax`` to the right of every panel, where it hides no data."""
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper", fontsize="small")


def plain_log_ticks(axis: Axis) -> None:
    """Label a logarithmic axis, once its data are drawn, with few plain numbers that do not touch.

    Matplotlib's own labels, 2 x 10^0 and the like, overlap where an axis is narrow.
    """
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    fine = {0.7: None, 1.7: (1, 2, 5), 2.7: (1, 3)}
    subs = next((subs for most, subs in fine.items() if decades < most), (1,))
    locator = MaxNLocator(4) if subs is None else LogLocator(subs=subs)
    axis.set_major_locator(locator)
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG."""
    figure.savefig(path, dpi=120)
    return path


def colours(planners: Iterable[str]) -> dict[str, str]:
    """A colour for each planner; the planners of this project have the same in every figure.

    Of several that differ in their options only, the first in the alphabet has it.
    """
    result: dict[str, str] = {}
    others = len(_OWN_COLOURS)
    taken = set()
    for planner in sorted(planners):
        name = planner.partition(",")[0]
        if name in _OWN_COLOURS and name not in taken:
            taken.add(name)
            result[planner] = colour(_OWN_COLOURS.index(name))
        else:
            result[planner] = colour(others)
            others += 1
    return result


def labels(planners: Iterable[str]) -> dict[str, str]:
    """A short text for each planner: its name, with options only where names are the same.

    Options are then one a line, paths among them without their folders.
    """
    names = {planner: planner.split(",") for planner in planners}
    count = Counter(name for name, *_ in names.values())
    return {
        planner: name if count[name] == 1 else "\n".join([name, *map(_without_folders, options)])
        for planner, (name, *options) in names.items()
    }


def _without_folders(option: str) -> str:
    name, equals, value = option.partition("=")
    return name + equals + value.rpartition("/")[2]


def colour(index: int) -> str:
    """One colour a series, distinguishable with common colour-vision deficiencies."""
    palette = matplotlib.color_sequences["petroff10"]
    return matplotlib.colors.to_hex(palette[index % len(palette)])


def planners_figure(rows: Sequence[Row]) -> Figure:
    """Every episode as a dot, the median with its 95 % interval beside them."""
    summary = summarise(rows)
    colour_of = colours(summary)
    rng = np.random.default_rng(0)
    figure = new_figure(len(PANELS), height=1.2 + 0.5 * len(summary))
    axes = figure.subplots(1, len(PANELS), sharey=True)
    for ax, panel in zip(axes, PANELS, strict=True):
        for index, (planner, metrics) in enumerate(summary.items()):
            values = panel.scale * _values(rows, planner, panel.metric)
            height = index + rng.uniform(-0.15, 0.15, len(values))
            ax.plot(values, height, ".", color=colour_of[planner], alpha=0.35, markersize=5)
            interval = metrics[panel.metric]
            value, low, high = (
                panel.scale * x for x in (interval.value, interval.low, interval.high)
            )
            ax.errorbar(
                value,
                index,
                xerr=[[max(0.0, value - low)], [max(0.0, high - value)]],
                fmt="o",
                color=colour_of[planner],
                capsize=4,
                markeredgecolor="black",
            )
        ax.set_xlabel(panel.heading)
        ax.grid(axis="x", alpha=0.3)
    errors = axes[PANELS.index(next(p for p in PANELS if p.metric == "ate_m"))]
    errors.set_xscale("log")
    plain_log_ticks(errors.xaxis)
    axes[0].set_yticks(range(len(summary)), labels(summary).values())
    axes[0].invert_yaxis()
    caption(figure, "Small dots: episodes. Circle and bar: median and its 95 % interval.")
    return figure


def scatter_figure(rows: Sequence[Row]) -> Figure:
    """F-score against ATE: the good corner is the upper left one."""
    figure = new_figure(width=6.4, height=3.8)
    ax = figure.subplots()
    planners = list(summarise(rows))
    colour_of, label_of = colours(planners), labels(planners)
    for planner in planners:
        ate = np.maximum(1000 * _values(rows, planner, "ate_m"), _FLOOR_MM)
        f_score = 100 * _values(rows, planner, "f_score_5cm")
        lost = _values(rows, planner, "lost").astype(bool)
        look: dict[str, Any] = {"color": colour_of[planner], "alpha": 0.7}
        ax.plot(ate[~lost], f_score[~lost], "o", label=label_of[planner], **look)
        ax.plot(ate[lost], f_score[lost], "x", **look)
    ax.set_xscale("log")
    plain_log_ticks(ax.xaxis)
    ax.set_xlabel("ATE [mm]")
    ax.set_ylabel("F-score at 5 cm [%]")
    ax.grid(alpha=0.3)
    legend_beside(figure, ax)
    caption(figure, "One mark an episode; cross: tracking was lost.")
    return figure


def ate_over_time_figure(rows: Sequence[Row]) -> Figure:
    """Running trajectory error: median over episodes, band between the quartiles."""
    figure = new_figure(width=6.4, height=3.8)
    ax = figure.subplots()
    planners = list(summarise(rows))
    colour_of, label_of = colours(planners), labels(planners)
    for planner in planners:
        series = [
            row["result"]["ate_over_time"] for row in rows if row["spec"]["planner"] == planner
        ]
        draw_band(ax, series, label_of[planner], colour_of[planner])
    ax.set_yscale("log")
    plain_log_ticks(ax.yaxis)
    ax.set_xlabel("step")
    ax.set_ylabel("running ATE, no alignment [mm]")
    ax.grid(alpha=0.3)
    legend_beside(figure, ax)
    caption(figure, "Line: median over episodes; band: between their quartiles.")
    return figure


def draw_band(ax: Axes, series: Sequence[Sequence[float]], label: str, color: str) -> None:
    """Median and quartiles of series in metres; a series that ends early keeps its last value."""
    length = max(map(len, series))
    padded = np.array([[*s, *[s[-1]] * (length - len(s))] for s in series])
    low, middle, high = np.percentile(np.maximum(1000 * padded, _FLOOR_MM), [25, 50, 75], axis=0)
    steps = np.arange(1, length + 1)
    ax.plot(steps, middle, color=color, label=label)
    ax.fill_between(steps, low, high, color=color, alpha=0.15, linewidth=0)


def _values(rows: Sequence[Row], planner: str, metric: str) -> np.ndarray:
    return np.array(
        [row["result"][metric] for row in rows if row["spec"]["planner"] == planner], dtype=float
    )
