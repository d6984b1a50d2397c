"""The experiment on frame selection: its pairs and its tables."""

from __future__ import annotations

import pytest

from ms_slam_env.experiments.frame_selection import FilterSpec, FrameSelection


def test_each_filter_runs_beside_regular_skipping_at_its_share():
    filters = ("none", "regular,every=2", "divergence,threshold=0.02")
    runs = FrameSelection.run(FilterSpec("wall:1000", filters, "surfel", "80x60", 40))["runs"]
    whole, half, own = runs
    assert whole["processed_share"] == 1.0
    assert whole["ate_m"] == whole["ate_processed_m"]
    assert half["processed_share"] == 0.5
    assert whole["regular"] is half["regular"] is None
    assert 0 < own["processed_share"] < 1
    assert own["regular"]["processed_share"] >= own["processed_share"] - 1 / 40


def test_tables_take_medians_and_count_pairs():
    def run(share: float, ate: float, f: float) -> dict[str, object]:
        names = ("lost_share", "ate_processed_m", "f_score_5cm", "cpu_ms_mean", "filter_cpu_ms")
        known = {"processed_share": share, "ate_m": ate, "f_score_2cm": f, "astray": False}
        return {**known, **dict.fromkeys(names, 0.5)}

    whole = {"frame_selection": "none", "regular": None}
    budget = {"frame_selection": "budget", "regular": run(0.5, 0.02, 0.7)}
    rows = [
        {
            "error": None,
            "spec": {"sequence": f"a{k}"},
            "result": {"runs": [{**whole, **run(1.0, ate, f)}, {**budget, **run(0.5, ate, f)}]},
        }
        for k, (ate, f) in enumerate([(0.01, 0.9), (0.03, 0.8), (0.015, 0.6)])
    ]
    rows.append({"error": "broken", "spec": {"sequence": "c"}, "result": None})
    medians, (pair,) = (table.rows for table in FrameSelection().tables(rows))
    assert [line["ate_m"].value for line in medians] == [0.015, 0.015]
    assert pair["regular_ate_m"].value == 0.02
    assert pair["better_ate_m"] == pair["better_f_score_2cm"] == pytest.approx(2 / 3)
    assert pair["better_ate_processed_m"] == 0
    ate = FrameSelection().charts(rows)[0].panels[0]
    assert ate.guides[0].value == 0.015
    assert [series.x for series in ate.series] == [[0.5] * 3, [0.5]]
