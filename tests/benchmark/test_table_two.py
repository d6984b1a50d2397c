"""Table II compares pairs of episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ms_slam_env.benchmark import planner_report, table_two
from ms_slam_env.report.records import Row


def result(score: float) -> dict[str, Any]:
    columns = (*planner_report.HEADLINE, *planner_report.DETAILS)
    metrics: dict[str, Any] = {column.metric: score for column in columns}
    return {**metrics, "lost": score < 0.3, "ate_over_time": [0.001, 0.002, score]}


def test_table_two_compares_pairs(tmp_path: Path) -> None:
    args = table_two.Arguments(episodes=4)
    rows: list[Row] = []
    for spec in args.specs():
        score = (0.1 if spec.planner == "random" else 0.06) * (1 + spec.seed - 2000)
        rows.append({"spec": vars(spec), "error": None, "result": result(score)})
    broken = next(i for i, row in enumerate(rows) if row["spec"]["planner"] == "greedy")
    rows[broken] = {**rows[broken], "result": None, "error": "x"}
    experiments = {
        name: table_two.compare(rows, env_id, "random", "greedy")
        for name, env_id in table_two.EXPERIMENTS.items()
    }
    assert experiments["free motion"]["episodes"] == 3
    assert experiments["fixed translation"]["episodes"] == 4
    for experiment in experiments.values():
        assert experiment["cuts"]["ate_m"]["value"] == pytest.approx(0.4)
    text = table_two.as_table(experiments)
    assert "| free motion | 40 [40, 40] | 34 | 40 [40, 40] | 33 |" in text
    assert "| fixed translation | 40 [40, 40] | 32 | 40 [40, 40] | 10 |" in text
    table_two.save_figure(rows, ("random", "greedy"), tmp_path / "a.png")
