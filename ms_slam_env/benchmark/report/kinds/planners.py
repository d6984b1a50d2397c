"""The planner benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ms_slam_env.benchmark import figures
from ms_slam_env.benchmark.planner_report import DETAILS, HEADLINE
from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.report import statistics
from ms_slam_env.report.records import Row

_FLOOR_MM = 0.05  # errors below are drawn here on logarithmic axes
_HOVER = "ATE %{x:.3g} mm, F-score %{y:.3g} %<extra>%{fullData.name}</extra>"
_BY_SCENE = ("f_score_5cm", "ate_m", "rcm", "lost")


class Planners(Kind):
    """``ms-slam benchmark``: planners with SLAM in the loop."""

    name = "planner benchmark"
    about = (
        "Planners move the camera, a real SLAM estimates its path and maps the scene. A good "
        "planner maps much (F-score, completeness) and stays tracked (small ATE, seldom lost)."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Episodes with a planner, and a summary by planner."""
        summary, episodes = content.get("summary"), content.get("episodes")
        if not isinstance(summary, dict) or not isinstance(episodes, list) or not episodes:
            return False
        return all(isinstance(m, dict) and "f_score_5cm" in m for m in summary.values()) and all(
            isinstance(row, dict) and isinstance(row.get("spec"), dict) and "planner" in row["spec"]
            for row in episodes
        )

    def figures(self, result: Result) -> list[Figure]:
        """F-score against ATE, ATE over time, every measure by planner, by scene."""
        rows = [row for row in result.content["episodes"] if row.get("error") is None]
        planners = [p for p in result.content["summary"] if any(_of(rows, p))]
        label_of = figures.labels(planners)
        measures = [
            {"planner": label_of[p].replace("\n", ", "), **flatten(result.content["summary"][p])}
            for p in planners
        ]
        keys = [column.metric for column in (*HEADLINE, *DETAILS)]
        found = [
            scatter(rows, planners, result.content["summary"], label_of),
            over_time(rows, planners, label_of),
            bar_figure(measures, "Every measure", ["planner"], keys, coloured=True),
            bar_figure(by_scene(rows, planners, label_of), "By scene", ["scene", "planner"]),
        ]
        return [figure for figure in found if figure is not None]


def scatter(
    rows: Sequence[Row], planners: Sequence[str], summary: dict[str, Any], label_of: dict[str, str]
) -> Figure | None:
    """F-score against ATE, a mark an episode, the medians with their intervals."""
    data: list[dict[str, Any]] = []
    for index, planner in enumerate(planners):
        own = [row for row in _of(rows, planner) if _known(row, "ate_m", "f_score_5cm")]
        label = plots.text(label_of[planner])
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": label,
                "legendgroup": str(index),
                "showlegend": False,
                "x": plots.finite(max(1e3 * row["result"]["ate_m"], _FLOOR_MM) for row in own),
                "y": plots.finite(100 * row["result"]["f_score_5cm"] for row in own),
                "text": [_episode(row) for row in own],
                "opacity": 0.55,
                "marker": {
                    "color": plots.colour(index),
                    "size": 7,
                    "symbol": ["x" if row["result"].get("lost") else "circle" for row in own],
                },
                "hovertemplate": f"%{{text}}<br>{_HOVER}",
            }
        )
        data.append(_median(summary[planner], label, index))
    if not any(trace["x"] for trace in data):
        return None
    layout = plots.layout(
        plots.axis("ATE [mm]", log=True), plots.axis("F-score at 5 cm [%]", rangemode="tozero")
    )
    caption = (
        "Small marks: one an episode, a cross where tracking was lost. Large marks: medians with "
        "95 % intervals. The good corner is the upper left one."
    )
    return Figure("Map quality against trajectory error", caption, (plots.plot(data, layout),), 480)


def over_time(
    rows: Sequence[Row], planners: Sequence[str], label_of: dict[str, str]
) -> Figure | None:
    """Running error: median over episodes, band between the quartiles."""
    data: list[dict[str, Any]] = []
    for index, planner in enumerate(planners):
        series = [row["result"].get("ate_over_time") for row in _of(rows, planner)]
        known = [s for s in series if s and None not in s]
        if not known:
            continue
        length = max(map(len, known))
        padded = np.array([[*s, *[s[-1]] * (length - len(s))] for s in known], dtype=float)
        low, middle, high = np.percentile(
            np.maximum(1e3 * padded, _FLOOR_MM), [25, 50, 75], axis=0
        ).tolist()
        steps = [float(step) for step in range(1, length + 1)]
        label = plots.text(label_of[planner])
        band = plots.band(label_of[planner], steps, low, high, index)
        line = plots.line(label_of[planner], steps, middle, index)
        data += [
            {**band, "legendgroup": str(index)},
            {**line, "name": label, "legendgroup": str(index)},
        ]
    if not data:
        return None
    layout = plots.layout(plots.axis("step"), plots.axis("running ATE, unaligned [mm]", log=True))
    caption = "Line: median over episodes; band: between their quartiles."
    return Figure("Trajectory error over time", caption, (plots.plot(data, layout),))


def by_scene(
    rows: Sequence[Row], planners: Sequence[str], label_of: dict[str, str]
) -> list[Record]:
    """A few measures of every planner in every scene; empty with one scene."""
    scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    found: list[Record] = []
    for scene in scenes if len(scenes) > 1 else ():
        for planner in planners:
            own = [row for row in _of(rows, planner) if row["spec"]["scene"] == scene]
            record: Record = {"scene": scene, "planner": label_of[planner].replace("\n", ", ")}
            for key in _BY_SCENE:
                values = [float(row["result"][key]) for row in own if _known(row, key)]
                share = statistics.share_interval if key == "lost" else statistics.median_interval
                record[key] = share(values) if values else None
            found.append(record)
    return found


def _median(metrics: dict[str, Any], label: str, index: int) -> dict[str, Any]:
    ate, f_score = flatten(metrics).get("ate_m"), flatten(metrics).get("f_score_5cm")
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "markers",
        "name": label,
        "legendgroup": str(index),
        "x": [],
        "y": [],
        "marker": {
            "color": plots.colour(index),
            "size": 14,
            "symbol": plots.symbol(index),
            "line": {"width": 1.5, "color": "#ffffff"},
        },
        "hovertemplate": f"median: {_HOVER}",
    }
    if isinstance(ate, statistics.Interval) and isinstance(f_score, statistics.Interval):
        x, low, high = (max(1e3 * v, _FLOOR_MM) for v in (ate.value, ate.low, ate.high))
        trace["x"], trace["y"] = plots.finite([x]), plots.finite([100 * f_score.value])
        trace["error_x"] = plots.error_bar([x], [low], [high])
        trace["error_y"] = plots.error_bar(
            [100 * f_score.value], [100 * f_score.low], [100 * f_score.high]
        )
    return trace


def _of(rows: Sequence[Row], planner: str) -> list[Row]:
    return [row for row in rows if row["spec"]["planner"] == planner]


def _known(row: Row, *keys: str) -> bool:
    return all(isinstance(row["result"].get(key), (int, float)) for key in keys)


def _episode(row: Row) -> str:
    spec = row["spec"]
    return plots.text(f"{spec.get('scene')}, seed {spec.get('seed')}")
