"""Tables and the figure of the robot experiment, made from its finished runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ms_slam_env.benchmark.figures import caption, colours, labels, legend_beside, new_figure, save
from ms_slam_env.benchmark.planner_report import Column, finished
from ms_slam_env.report import statistics
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, markdown_table

Cell = dict[str, Interval]
Summary = dict[tuple[str, str], Cell]

SHARES = (
    Column("success", "success [%]", 100),
    Column("success_tracked", "success, not lost at the end [%]", 100),
    Column("lost", "lost at some time [%]", 100),
)
MEDIANS = (
    Column("lost_frames_share", "frames lost [%]", 100),
    Column("mapped_area_m2", "mapped [m²]"),
    Column("ate_m", "ATE [mm]", 1000),
    Column("worst_share", "worst object's share apart [%]", 100),
    Column("path_length_m", "path [m]"),
    Column("energy_j", "energy [J]"),
    Column("steps", "motions"),
)
PAPER = {
    "carpet": {"random": (0, 10), "greedy": (5, 10)},
}
"""Successes and runs that the paper's text states; its other bars are in its figure 9 alone."""
ACTIVE, BASELINE = "greedy", "random"


def summarise(rows: Sequence[Row]) -> Summary:
    """Shares with Wilson intervals and medians with bootstrap intervals, by scene and planner."""
    cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in finished(rows):
        key = row["spec"]["scene"], row["spec"]["planner"]
        cells.setdefault(key, []).append(row["result"])
    summary: Summary = {}
    for key, results in cells.items():
        shares = {c.metric: statistics.share_interval(_values(results, c)) for c in SHARES}
        medians = {c.metric: statistics.median_interval(_numbers(results, c)) for c in MEDIANS}
        summary[key] = shares | medians
    return summary


def compare(rows: Sequence[Row]) -> dict[str, Any]:
    """Successes of the greedy planner and of random walk, by scene, with the paper's.

    ``winner`` is the one with the greater share, ``equal``, or None where one has no runs.
    """
    counts = _counts(rows)
    scenes = dict.fromkeys(scene for scene, _ in counts)
    result = {}
    for scene in scenes:
        ours = {planner: counts.get((scene, planner), (0, 0)) for planner in (BASELINE, ACTIVE)}
        shares = [wins / runs if runs else math.nan for wins, runs in ours.values()]
        winner = BASELINE if shares[0] > shares[1] else ACTIVE if shares[1] > shares[0] else "equal"
        result[scene] = {
            **ours,
            "winner": None if any(map(math.isnan, shares)) else winner,
            "paper": PAPER.get(scene),
        }
    return result


def _counts(rows: Sequence[Row]) -> dict[tuple[str, str], tuple[int, int]]:
    """Successes and runs, by scene and name of the planner without its options."""
    counts: dict[tuple[str, str], tuple[int, int]] = {}
    for row in finished(rows):
        key = row["spec"]["scene"], row["spec"]["planner"].partition(",")[0]
        wins, runs = counts.get(key, (0, 0))
        counts[key] = wins + bool(row["result"]["success"]), runs + 1
    return counts


def as_text(rows: Sequence[Row], seconds: float, made_by: Mapping[str, Any]) -> str:
    """The Markdown report."""
    commits = sorted({row["commit"] for row in rows if row["commit"]})
    return (
        f"Runs of {seconds:g} simulated seconds. A run succeeds if its map shows no object twice. "
        "Shares of runs with 95 % Wilson intervals, medians with 95 % bootstrap intervals. "
        "Standing still succeeds trivially: read success beside the mapped area.\n\n"
        + cells_table(rows)
        + "\n### Beside the paper\n\n"
        + comparison_table(rows)
        + f"\nMade by `{made_by['command']}`, version {made_by['versions']['ms-slam-env']}"
        f"{''.join(f', commit {commit}' for commit in commits)}, on {made_by['cpu']}.\n"
    )


def cells_table(rows: Sequence[Row]) -> str:
    """Markdown: one line a scene and planner."""
    runs = {key: 0 for key in summarise(rows)}
    for row in finished(rows):
        runs[row["spec"]["scene"], row["spec"]["planner"]] += 1
    body = [
        [
            scene,
            planner,
            str(runs[scene, planner]),
            *(format_interval(cell[c.metric], c.scale) for c in (*SHARES, *MEDIANS)),
        ]
        for (scene, planner), cell in summarise(rows).items()
    ]
    headings = [column.heading for column in (*SHARES, *MEDIANS)]
    return markdown_table(["scene", "planner", "runs", *headings], body)


def comparison_table(rows: Sequence[Row]) -> str:
    """Markdown: successes of greedy and random walk beside the paper's claim."""
    body = []
    for scene, entry in compare(rows).items():
        paper = entry["paper"] or {}
        claim = ", ".join(f"{name} {wins} of {runs}" for name, (wins, runs) in paper.items())
        body.append(
            [
                scene,
                *("{} of {}".format(*entry[planner]) for planner in (BASELINE, ACTIVE)),
                entry["winner"] or "-",
                f"{ACTIVE} better{': ' + claim if claim else ''}",
            ]
        )
    return markdown_table(["scene", BASELINE, ACTIVE, "better", "paper"], body)


def as_plain(cell: Cell) -> dict[str, Any]:
    """A cell as plain values, for JSON."""
    return {name: asdict(value) for name, value in cell.items()}


def save_figure(summary: Summary, path: Path) -> Path:
    """Draw success, success without being lost at the end, and the mapped area."""
    panels = (SHARES[0], SHARES[1], MEDIANS[1])
    figure = new_figure(len(panels), width=4.2)
    axes = figure.subplots(1, len(panels))
    for ax, column in zip(axes, panels, strict=True):
        _draw_bars(ax, summary, column)
    for ax in axes[:2]:
        ax.set_ylim(0, 105)
    legend_beside(figure, axes[0])
    caption(
        figure,
        "A map fails if it shows an object twice. Bars: share of runs (area: median); "
        "lines: 95 % intervals; crosses: the paper's carpet.",
    )
    return save(figure, path)


def _draw_bars(ax: Axes, summary: Summary, column: Column) -> None:
    scenes = list(dict.fromkeys(scene for scene, _ in summary))
    planners = list(dict.fromkeys(planner for _, planner in summary))
    colour_of, label_of = colours(planners), labels(planners)
    width = 0.8 / len(planners)
    for index, planner in enumerate(planners):
        known = [scene for scene in scenes if (scene, planner) in summary]
        cells = [summary[scene, planner][column.metric] for scene in known]
        places = np.array([scenes.index(scene) for scene in known])
        places = places + (index - (len(planners) - 1) / 2) * width
        value = np.array([column.scale * cell.value for cell in cells])
        below = value - [column.scale * cell.low for cell in cells]
        above = [column.scale * cell.high for cell in cells] - value
        ax.bar(places, value, 0.9 * width, color=colour_of[planner], label=label_of[planner])
        reach = np.maximum(0, [below, above])
        ax.errorbar(places, value, reach, fmt="none", ecolor="black", capsize=2, linewidth=1)
        if column.metric == "success":
            for scene, place in zip(known, places, strict=True):
                if planner in PAPER.get(scene, {}):
                    wins, runs = PAPER[scene][planner]
                    ax.plot(place, 100 * wins / runs, "x", color="black", markersize=7)
    ax.set_xticks(range(len(scenes)), [Path(scene).stem for scene in scenes])
    ax.set_ylabel(column.heading)
    ax.grid(axis="y", alpha=0.3)


def _values(results: Sequence[dict[str, Any]], column: Column) -> list[Any]:
    return [result[column.metric] for result in results]


def _numbers(results: Sequence[dict[str, Any]], column: Column) -> list[float]:
    """Values without those that no map gave, such as a share of no object."""
    return [x for x in _values(results, column) if x is not None and not math.isnan(x)]
