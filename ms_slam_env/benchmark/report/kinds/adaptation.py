"""Run-time adaptation against fixed configurations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure, Plot
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import flatten
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.benchmark.report.kinds.scatter import scatter_plot

_SMALLEST_CHANGE = 1e-4  # nats; what is below is drawn there
_MOST_TIME_LINES = 12


class Adaptation(Kind):
    """A SLAM that switches among configurations while it runs."""

    name = "run-time adaptation"
    about = (
        "A running SLAM takes a fast configuration while little changes from frame to frame, and a "
        "robust one where much does; the others keep one configuration all the time."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Sequences with several runs each, and the divergence that switched."""
        rows = content.get("sequences")
        return (
            isinstance(rows, list)
            and bool(rows)
            and all(
                isinstance(row.get("result"), dict) and isinstance(row["result"].get("runs"), dict)
                for row in rows
                if isinstance(row, dict) and row.get("error") is None
            )
            and any(isinstance(row, dict) and row.get("result") for row in rows)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Error against time, every measure, switching along a sequence."""
        rows = [row for row in result.content["sequences"] if row.get("error") is None]
        names = list(rows[0]["result"]["runs"])
        runs = {
            name: [
                (run["cpu_ms"], run["ate_m"], _label(row))
                for row in rows
                if (run := row["result"]["runs"].get(name)) and run.get("ate_m") is not None
            ]
            for name in names
        }
        caption = "Small marks: one a sequence; large marks: medians. Down and left is good."
        plot = scatter_plot(runs, "cpu_ms", "ate_m")
        summary = [flatten(row) for row in result.content.get("summary") or ()]
        found = [
            Figure("Error against time", caption, (plot,), 480),
            bar_figure(summary, "Every measure", ["name"], coloured=True),
            time_line(rows),
        ]
        return [figure for figure in found if figure is not None]


def time_line(rows: list[Mapping[str, Any]]) -> Figure | None:
    """Change between frames and the configuration in force, a sequence at a time."""
    found = [_time_line(row) for row in rows[:_MOST_TIME_LINES] if row["result"].get("change")]
    if not found:
        return None
    caption = (
        "Above: divergence from the frame before, with the thresholds (dashed). Below: the "
        "configuration in force, 0 being the fast one. Shaded: violent motion."
    )
    return Figure("Switching along a sequence", caption, tuple(found), 460, "Sequence")


def _time_line(row: Mapping[str, Any]) -> Plot:
    result = row["result"]
    change = [max(value or 0.0, _SMALLEST_CHANGE) for value in result["change"]]
    frames = [float(k) for k in range(len(change))]
    data = [plots.line("divergence", frames, change, 0)]
    for threshold in result.get("thresholds") or ():
        line = plots.line("threshold", [0.0, frames[-1]], [threshold, threshold], 8)
        line["line"] = {"color": plots.colour(8), "dash": "dash", "width": 1.2}
        data.append(line)
    level = plots.line("configuration", frames, result["level"], 1, yaxis="y2")
    level["line"]["shape"] = "hv"
    data.append(level)
    shades = [
        {
            "type": "rect", "yref": "paper", "x0": first - 0.5, "x1": last + 0.5, "y0": 0, "y1": 1,
            "fillcolor": plots.colour(8), "opacity": 0.18, "line": {"width": 0}, "layer": "below",
        }
        for first, last in _stretches(result.get("violent") or [])
    ]  # fmt: skip
    layout = plots.layout(
        plots.axis("frame", anchor="y2"),
        plots.axis("divergence [nats]", log=True, domain=[0.36, 1.0]),
        yaxis2=plots.axis("configuration", domain=[0.0, 0.28], dtick=1),
        shapes=shades,
        showlegend=False,
    )
    return Plot(_label(row), data, layout)


def _stretches(flags: list[bool]) -> list[tuple[int, int]]:
    """First and last index of each stretch of true values."""
    found: list[tuple[int, int]] = []
    for index, flag in enumerate(flags):
        if flag and found and found[-1][1] == index - 1:
            found[-1] = (found[-1][0], index)
        elif flag:
            found.append((index, index))
    return found


def _label(row: Mapping[str, Any]) -> str:
    spec = row.get("spec") or {}
    return f"{spec.get('scene')}, seed {spec.get('seed')}"
