"""The experiment on frame selection: its pairs and its tables."""

from __future__ import annotations

import pytest
from ms_slam_experiments.frame_selection import FrameSelection


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


def test_a_line_joins_thresholds_of_one_reference():
    names = [
        f"divergence,threshold={t}{more}" for t in (1, 2) for more in ("", ",reference=previous")
    ]
    known = dict.fromkeys(("processed_share", "ate_m", "ate_processed_m"), 0.5)
    known |= {"f_score_2cm": 0.5, "cpu_ms_mean": 1.0}
    runs = [{"frame_selection": name, **known} for name in names]
    rows = [{"error": None, "spec": {"sequence": "a"}, "result": {"runs": runs}}]
    (chart,) = FrameSelection().charts(rows)
    lines = [series for series in chart.panels[0].series if series.mode != "dots"]
    assert {line.name: len(line.x) for line in lines} == {
        "divergence": 2,
        "divergence,reference=previous": 2,
    }
