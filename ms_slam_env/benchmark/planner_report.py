"""The planner benchmark's table and aggregates, made from its finished episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.report import statistics
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, markdown_table

RANKED_BY = "f_score_5cm"
"""Standing still loses it by recall, getting lost by precision."""


@dataclass(frozen=True)
class Column:
    """One column: a metric, its heading with the unit, and the factor to that unit."""

    metric: str
    heading: str
    scale: float = 1.0


HEADLINE = (
    Column("f_score_5cm", "F-score 5 cm %", 100),
    Column("f_score_2cm", "F-score 2 cm %", 100),
    Column("rcm", "RCM %", 100),
    Column("ate_m", "ATE mm", 1000),
    Column("lost", "lost % of episodes", 100),
    Column("path_length_m", "path m"),
    Column("decision_ms", "decision ms"),
)
DETAILS = (
    Column("ate_max_m", "ATE max mm", 1000),
    Column("rpe_m", "RPE mm", 1000),
    Column("rer_m", "RER mm", 1000),
    Column("mapped_area_m2", "mapped m²"),
    Column("M_I", "M_I"),
    Column("M_D", "M_D"),
    Column("return", "return"),
)


def summarise(rows: Sequence[Row]) -> dict[str, dict[str, Interval]]:
    """Median (share, for ``lost``) and interval of every metric, by planner, best first."""
    planners = list(dict.fromkeys(row["spec"]["planner"] for row in rows))
    summary = {planner: _summarise_planner(rows, planner) for planner in planners}
    return dict(sorted(summary.items(), key=lambda item: _rank(item[1])))


def _rank(metrics: dict[str, Interval]) -> float:
    value = metrics[RANKED_BY].value
    return np.inf if np.isnan(value) else -value


def _summarise_planner(rows: Sequence[Row], planner: str) -> dict[str, Interval]:
    results = [row["result"] for row in finished(rows) if row["spec"]["planner"] == planner]
    summary = {}
    for column in (*HEADLINE, *DETAILS):
        values = [result[column.metric] for result in results]
        values = [value for value in values if not math.isnan(value)]  # RER of an empty map
        measure = (
            statistics.share_interval if column.metric == "lost" else statistics.median_interval
        )
        summary[column.metric] = measure(values)
    return summary


def finished(rows: Sequence[Row]) -> list[Row]:
    """The rows without an error."""
    return [row for row in rows if row["error"] is None]


def planner_table(rows: Sequence[Row]) -> str:
    """Markdown tables over all scenes and, if there are several, one for each scene."""
    scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    parts = [_one_table(rows, HEADLINE), "\n", _one_table(rows, DETAILS)]
    if len(scenes) > 1:
        for scene in scenes:
            of_scene = [row for row in rows if row["spec"]["scene"] == scene]
            parts.append(f"\n### {scene}\n\n{_one_table(of_scene, HEADLINE)}")
    return "".join(parts)


def _one_table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    body = []
    for planner, metrics in summarise(rows).items():
        count = sum(row["spec"]["planner"] == planner for row in finished(rows))
        cells = [format_interval(metrics[c.metric], c.scale) for c in columns]
        body.append([planner, str(count), *cells])
    return markdown_table(["planner", "episodes", *(c.heading for c in columns)], body)


def score_matrices(rows: Sequence[Row], metric: str = RANKED_BY) -> dict[str, NDArray[np.float64]]:
    """Scores (episodes, scenes) of each planner that finished an episode in every scene.

    Scenes with more finished episodes than another lose the surplus, as rliable needs a matrix.
    """
    scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    planners = list(dict.fromkeys(row["spec"]["planner"] for row in rows))
    matrices = {}
    for planner in planners:
        columns: list[list[float]] = [
            [
                row["result"][metric]
                for row in finished(rows)
                if (row["spec"]["planner"], row["spec"]["scene"]) == (planner, scene)
            ]
            for scene in scenes
        ]
        count = min(map(len, columns))
        if count:
            matrices[planner] = np.array([column[:count] for column in columns]).T
    return matrices


def aggregate(rows: Sequence[Row], baseline: str = "random") -> dict[str, Any] | None:
    """rliable's interquartile mean and probability of improvement; None without rliable."""
    scores = score_matrices(rows)
    if not statistics.has_rliable() or not scores:
        return None
    result: dict[str, Any] = {
        "metric": RANKED_BY,
        "interquartile_mean": {
            name: asdict(value) for name, value in statistics.interquartile_means(scores).items()
        },
    }
    if baseline in scores and len(scores) > 1:
        result["probability_of_improvement"] = {
            "over": baseline,
            **{
                name: asdict(value)
                for name, value in statistics.improvement_probabilities(scores, baseline).items()
            },
        }
    return result


def aggregate_table(aggregates: dict[str, Any]) -> str:
    """Markdown table of :func:`aggregate`."""
    means = aggregates["interquartile_mean"]
    better = aggregates.get("probability_of_improvement", {})
    over = better.get("over", "")
    header = ["planner", "interquartile mean F-score 5 cm %"]
    if better:
        header.append(f"P(better than {over}) %")
    body = []
    for name in sorted(means, key=lambda n: -means[n]["value"]):
        line = [name, format_interval(Interval(**means[name]), 100)]
        if better:
            line.append(format_interval(Interval(**better[name]), 100) if name in better else "-")
        body.append(line)
    return markdown_table(header, body)
