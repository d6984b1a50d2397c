"""The tables of an exploration: what few trials cannot say."""

from __future__ import annotations

from typing import Any, cast

import pytest

from ms_slam_env.report.statistics import Interval
from ms_slam_env.tuning.front import Point
from ms_slam_env.tuning.results import Explored


@pytest.mark.parametrize(("trials", "is_warned"), [(19, True), (20, False)])
def test_importances_from_few_trials_say_so(trials: int, is_warned: bool) -> None:
    explored = Explored(
        objectives=("ate_m", "ext_ms"),
        clock="ext_ms",
        parameters=("icp_rgb_weight", "depth_cutoff_m"),
        points=cast("Any", [None] * trials),
        chosen={},
        reference={},
        hypervolume=(),
        importance={"ate_m": {"icp_rgb_weight": 0.7, "depth_cutoff_m": 0.3}},
        held_out=(),
        again=(),
    )
    note = explored._importance().note
    assert f"From {trials} trials" in note
    assert ("chance" in note) == is_warned


def _line(name: str, ate: Interval, time: Interval, sequences: int = 4) -> dict[str, Any]:
    figures = {"ate_m": 0.01, "cpu_ms_median": 5.0, "load_cpu_ms": 5.0, "load_cpu_ms_ratio": time}
    ratios = {"ate_m_ratio": ate, "cpu_ms_median_ratio": time}
    return (
        {"configuration": name, "sequences_count": sequences, "failed_runs": 0} | figures | ratios
    )


SURE, CHANCE, SAME = Interval(0.5, 0.3, 0.9), Interval(0.9, 0.7, 1.2), Interval(1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("accurate", "fast", "sequences", "said"),
    [
        (SURE, SURE, 4, "contains 1 chance may have made it; here it does not."),
        (CHANCE, SURE, 4, "it may have here: most accurate (ATE)."),
        (CHANCE, CHANCE, 4, "it may have here: most accurate (ATE), fastest (processor time)."),
        (SURE, SURE, 1, "Of one sequence: whether chance made a difference is not known."),
    ],
)
def test_what_may_have_won_by_chance_is_named(
    accurate: Interval, fast: Interval, sequences: int, said: str
) -> None:
    point = Point(3, {}, {}, (0.01, 5.0), True, True, False)
    explored = Explored(
        objectives=("ate_m", "ext_ms"),
        clock="processor",
        parameters=(),
        points=[],
        chosen={"fastest": point, "most_accurate": point},
        reference={},
        hypervolume=(),
        importance={},
        held_out=(),
        again=[
            _line("default", SAME, SAME, sequences),
            _line("fastest", CHANCE, fast, sequences),
            _line("most accurate", accurate, CHANCE, sequences),
        ],
    )
    _, table = explored.tables()
    assert said in table.note
    assert table.rows[0]["configuration"] == "default"


def test_every_frame_rate_has_a_front_of_its_own_and_absences_are_said() -> None:
    values = [(1, 0.02, 5.0), (1, 0.01, 7.0), (1, 0.03, 6.0), (2, 0.04, 4.0), (2, 0.05, 9.0)]
    points = [
        Point(
            number,
            {"keep_every": every},
            {"ate_m": ate, "ext_ms": ext, "M_I": 0.01 * every},
            (ate, ext),
            number != 1,
            False,
            number == 0,
        )
        for number, (every, ate, ext) in enumerate(values)
    ]
    explored = Explored(
        objectives=("ate_m", "ext_ms"),
        clock="processor",
        parameters=("keep_every",),
        points=points,
        chosen={"for-divergence": points[3]},
        reference={"ate_m": 0.06, "ext_ms": 15.0},
        hypervolume=[0.5],
        importance={},
        held_out=(),
        again=(),
        absent=["threads is absent: Warp runs a kernel on one thread"],
        levels=[3, 0],
    )
    (rates,) = (chart for chart in explored.charts() if chart.name == "rates")
    fronts = {series.name: (series.x, series.y) for series in rates.panels[0].series}
    assert fronts == {"every 1, M_I 0.010": ([5.0], [0.02]), "every 2, M_I 0.020": ([4.0], [0.04])}
    table = explored.tables()[0]
    purposes = {row["trial"]: row["purpose"] for row in table.rows}
    assert purposes == {0: "default, level 1", 3: "for-divergence, level 0"}
    assert "Threads is absent: Warp runs a kernel on one thread." in table.note
