"""Studies around explorations: samplers, rates of frames, difficulty of motions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure
from ms_slam_env.benchmark.report.curves import curve_figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten
from ms_slam_env.benchmark.report.glossary import Meanings, heading
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.benchmark.report.kinds.exploration import evaluation_meanings
from ms_slam_env.benchmark.report.kinds.scatter import scatter_plot


class Samplers(Kind):
    """Samplers of an exploration at equal budget."""

    name = "samplers of an exploration"
    about = "How fast the Pareto front grows with different samplers of configurations."

    def fits(self, content: dict[str, Any]) -> bool:
        """Histories of the hypervolume by sampler."""
        given = content.get("hypervolume")
        return (
            isinstance(given, dict)
            and bool(given)
            and all(
                isinstance(runs, list) and runs and isinstance(runs[0], list)
                for runs in given.values()
            )
        )

    def figures(self, result: Result) -> list[Figure]:
        """Hypervolume over trials; the summary."""
        rows = [flatten(row) for row in result.content.get("summary") or ()]
        found = [
            histories_figure(result.content["hypervolume"]),
            bar_figure(rows, "Summary", ["sampler"], coloured=True),
        ]
        return [figure for figure in found if figure is not None]


class Rates(Kind):
    """One configuration when every n-th frame is processed."""

    name = "error and time at different divergences"
    about = (
        "Every n-th frame is processed, which makes the divergence between processed frames "
        "larger (ICRA 2017, Figs. 3 and 5)."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """A summary by rate, with divergences."""
        summary = content.get("summary")
        return (
            isinstance(summary, list)
            and bool(summary)
            and all(isinstance(r, dict) and {"keep_every", "M_I"} <= set(r) for r in summary)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Error against time and divergence, run by run; medians over the rate."""
        runs = [row for row in result.content.get("runs") or () if row.get("ate_m")]
        rows = [flatten(row) for row in result.content["summary"]]
        groups = {
            name: [row for row in runs if bool(row.get("failure")) == failed]
            for name, failed in (("tracked", False), ("lost", True))
        }
        pairs = (("M_I", "ate_m"), ("M_D", "ate_m"), ("ext_ms", "ate_max_m"), ("load_ms", "ate_m"))
        found = [
            scatter_plot(
                {
                    name: [(r[x], r[y], _rate(r)) for r in own if r.get(x) and r.get(y)]
                    for name, own in groups.items()
                },
                x,
                y,
                f"{heading(y)} against {heading(x)}",
                medians=False,
            )
            for x, y in pairs
        ]
        shown = [plot for plot in found if any(trace["x"] for trace in plot.data)]
        keys = ["ate_m", "ate_max_m", "M_I", "M_D", "ext_ms", "load_ms", "failed"]
        drawn = [
            Figure("Every run", "One mark a sequence and rate.", tuple(shown), 460, "Axes")
            if shown
            else None,
            curve_figure(rows, "keep_every", None, keys, "Medians over the rate"),
        ]
        return [figure for figure in drawn if figure is not None]

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """Time, memory and divergence as an exploration measures them."""
        return evaluation_meanings(content)


class Difficulty(Kind):
    """Motions in several scenes."""

    name = "difficulty of motions"
    about = (
        "The divergence from frame to frame along the ICL-NUIM motions, in several scenes, "
        "beside the order that the paper found (kt2 and kt3 harder than kt0 and kt1)."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Statistics by scene, motion and kind of divergence."""
        rows = content.get("statistics")
        needed = {"scene", "motion", "setting", "divergence", "mean"}
        return (
            isinstance(rows, list)
            and bool(rows)
            and all(isinstance(row, dict) and needed <= set(row) for row in rows)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Statistics by motion, a figure for each kind of divergence."""
        keys = ("mean", "max", "std", "variance", "mean_per_s", "max_per_s", "std_per_s")
        rows = [flatten(row) for row in result.content["statistics"]]
        found = []
        for kind in dict.fromkeys(str(row["divergence"]) for row in rows):
            own: list[Record] = [
                {"where": _where(row), **row} for row in rows if row["divergence"] == kind
            ]
            title = f"{kind} divergence"
            found.append(bar_figure(own, title, ["where", "motion"], keys))
        return [figure for figure in found if figure is not None]

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """What the frames show and how the camera moves."""
        return (
            (r"turn \[deg/s\]", "How fast the camera turns."),
            (r"speed \[m/s\]", "How fast the camera moves."),
            (
                r"image motion \[deg/s\]",
                "Mean angle by which the surface points of a frame move in the camera's view.",
            ),
            (r"contrast", "Standard deviation of the grey values, mean over the frames."),
            (r"depth \[m\]", "Depth that the frames show, mean over the frames."),
        )


def histories_figure(histories: dict[str, list[list[float]]]) -> Figure:
    """Mean over the seeds, with its 95 % interval as a band."""
    data: list[dict[str, Any]] = []
    for index, (name, runs) in enumerate(histories.items()):
        length = min(map(len, runs))
        values = np.array([run[:length] for run in runs], dtype=float)
        trials = [float(k + 1) for k in range(length)]
        mean = values.mean(axis=0)
        if len(values) > 1:
            half = 1.96 * values.std(axis=0, ddof=1) / np.sqrt(len(values))
            data.append(
                plots.band(name, trials, (mean - half).tolist(), (mean + half).tolist(), index)
            )
        line = plots.line(name, trials, mean.tolist(), index, legendgroup=plots.short(name))
        line["line"]["dash"] = plots.dash(index)
        data.append(line)
    axes = plots.axis("finished trials"), plots.axis("hypervolume")
    caption = "Line: mean over the seeds; band: its 95 % interval."
    plot = plots.plot(data, plots.layout(*axes, showlegend=True))
    return Figure("Hypervolume over trials", caption, (plot,))


def _rate(row: dict[str, Any]) -> str:
    return f"{row.get('sequence')}, every {row.get('keep_every')}"


def _where(row: Record) -> str:
    names: Sequence[str] = (
        Path(str(row["scene"])).stem,
        str(row.get("noise")),
        str(row["setting"]),
    )
    return ", ".join(names)
