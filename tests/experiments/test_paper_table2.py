"""Table II compares pairs of episodes."""

from __future__ import annotations

from typing import Any

import pytest

from ms_slam_env.experiments.paper_table2 import METRICS, PaperTable2
from ms_slam_env.report.records import Row


def test_table_two_compares_pairs() -> None:
    experiment = PaperTable2(episodes=4)
    rows: list[Row] = []
    for spec in experiment.specs():
        score = (0.1 if spec.planner == "random" else 0.06) * (1 + spec.seed - 2000)
        result = {**dict.fromkeys(METRICS, score), "lost": score < 0.3}
        rows.append({"spec": vars(spec), "error": None, "result": result})
    broken = next(i for i, row in enumerate(rows) if row["spec"]["planner"] == "greedy")
    rows[broken] = {**rows[broken], "result": None, "error": "x"}
    medians, cuts = experiment.tables(rows)
    assert [line["episodes"] for line in medians.rows] == [3, 3, 4, 4]
    lines: Any = cuts.rows
    assert [line["ate_cut"].value for line in lines] == [pytest.approx(0.4)] * 2
    text = cuts.as_markdown()
    assert "| free motion | 40 [40, 40] | 34 | 40 [40, 40] | 33 |" in text
    assert "| fixed translation | 40 [40, 40] | 32 | 40 [40, 40] | 10 |" in text
    (chart,) = experiment.charts(rows)
    assert [panel.title for panel in chart.panels] == ["free motion"] * 2 + [
        "fixed translation"
    ] * 2
