"""The planner benchmark: scenes x seeds x planners, every planner from the same start pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.experiments.harness.episode_experiment import DOTS, SteppedExperiment
from ms_slam_env.experiments.harness.episodes import (
    DEFAULT_PLANNERS,
    DEFAULT_SCENES,
    short_planner_names,
)
from ms_slam_env.report import statistics
from ms_slam_env.report.charts import (
    Chart,
    Panel,
    by_group,
    quartile_band,
    scatter,
)
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Grouping, Table, finished, make_table

RANKED_BY = "f_score_5cm"
"""Standing still loses it by recall, getting lost by precision."""
HEADLINE = (
    *("f_score_5cm", "f_score_2cm", "rcm", "ate_m", "lost"),
    *("violations", "path_length_m", "decision_ms"),
)
DETAILS = ("ate_max_m", "rpe_m", "rer_m", "mapped_area_m2", "M_I", "M_D", "return")
_PANELS = ("f_score_5cm", "rcm", "ate_m", "path_length_m")
_FLOOR_M = 5e-5  # errors below are drawn here on logarithmic axes


@dataclass(frozen=True)
class PlannerBenchmark(SteppedExperiment):
    """Planner benchmark

    Planners move the camera, a real SLAM estimates its path and maps the scene. A good planner maps
    much (F-score, completeness) and stays tracked (small ATE, seldom lost).
    """

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = DEFAULT_SCENES
    episodes: int = 10
    steps: int = 100
    seeds: str = "test"
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    """Environment."""

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Over all scenes, across scenes, and for each scene."""
        headline = Grouping(("planner",), HEADLINE, rank_by=RANKED_BY, count="episodes")
        details = Grouping(("planner",), (RANKED_BY, *DETAILS), rank_by=RANKED_BY)
        note = (
            f"Medians with 95 % bootstrap intervals over episodes of {self.steps} steps of "
            f"{100 * self.step_m:g} cm / {self.step_deg:g} deg; best F-score first."
        )
        tables = [headline.table(rows, note=note), details.table(rows, "Details")]
        across = across_scenes(rows)
        tables += [across] if across else []
        scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
        if len(scenes) > 1:
            for scene in scenes:
                of_scene = [row for row in rows if row["spec"]["scene"] == scene]
                tables.append(headline.table(of_scene, scene))
        return tables

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Every measure by planner, F-score against ATE, ATE over time."""
        ranking = Grouping(("planner",), (RANKED_BY,), rank_by=RANKED_BY).table(rows)
        best = [str(line["planner"]) for line in ranking.rows]
        label = short_planner_names(best).__getitem__
        bands = [
            quartile_band(
                label(name),
                [r["result"]["ate_over_time"] for r in finished(rows) if _planner(r) == name],
                _FLOOR_M,
            )
            for name in best
        ]
        return [
            Chart(
                "planners",
                "Measures by planner",
                DOTS,
                by_group(rows, "planner", _PANELS, ("ate_m",), best, label),
            ),
            Chart(
                "f_score_ate",
                "F-score against ATE",
                "One mark an episode.",
                [scatter(rows, "ate_m", RANKED_BY, "planner", "x", _FLOOR_M, label)],
            ),
            Chart(
                "ate_over_time",
                "Error over time",
                "Line: median over episodes; band: between their quartiles.",
                [Panel("steps", "ate_over_time", bands, "y")],
            ),
        ]

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The seeds, and medians with their intervals by planner."""
        grouping = Grouping(("planner",), (*HEADLINE, *DETAILS), rank_by=RANKED_BY)
        lines: Sequence[Mapping[str, Any]] = grouping.table(rows).rows
        return {
            **super().content(rows),
            "summary": {
                line["planner"]: {key: asdict(line[key]) for key in grouping.keys} for line in lines
            },
        }


def _planner(row: Mapping[str, Any]) -> str:
    return str(row["spec"]["planner"])


def score_matrices(rows: Sequence[Row], metric: str = RANKED_BY) -> dict[str, NDArray[np.float64]]:
    """Scores (episodes, scenes) of each planner that finished an episode in every scene.

    Scenes with more finished episodes than another lose the surplus, as rliable needs a matrix.
    """
    scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    matrices = {}
    for planner in dict.fromkeys(map(_planner, rows)):
        columns: list[list[float]] = [
            [
                row["result"][metric]
                for row in finished(rows)
                if (_planner(row), row["spec"]["scene"]) == (planner, scene)
            ]
            for scene in scenes
        ]
        count = min(map(len, columns))
        if count:
            matrices[planner] = np.array([column[:count] for column in columns]).T
    return matrices


def across_scenes(rows: Sequence[Row], baseline: str = "random") -> Table | None:
    """rliable's interquartile mean and probability of improvement; None without rliable."""
    scores = score_matrices(rows)
    if not statistics.has_rliable() or not scores:
        return None
    means = statistics.interquartile_means(scores)
    better: dict[str, statistics.Interval] = {}
    if baseline in scores and len(scores) > 1:
        better = statistics.improvement_probabilities(scores, baseline)
    columns = ["planner", "f_score_5cm_iqm", *(["better_than_random"] if better else [])]
    lines = [
        {"planner": name, "f_score_5cm_iqm": means[name], "better_than_random": better.get(name)}
        for name in sorted(means, key=lambda name: -means[name].value)
    ]
    return make_table(columns, lines, "Across scenes")
