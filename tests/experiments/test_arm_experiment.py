"""The robot experiment: real runs, short ones, and its tables on made-up ones."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ms_slam_experiments.arm_experiment import (
    METRICS,
    ArmExperiment,
    RunSpec,
    compare,
    judge_episode,
)
from ms_slam_experiments.duplicate_objects import DuplicateObjects

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.consistency import ConsistencyRule
from ms_slam_env.metrics.registry import check_keys, metric

FREE = "MSActiveSLAM-FreeCamera-v0"


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return ArmExperiment.run(RunSpec("random", "table", 1000, FREE, steps=100, seconds=0.19))


def test_a_run_ends_after_its_seconds(result: dict[str, Any]) -> None:
    assert result["time_s"] == pytest.approx(0.2)
    assert result["steps"] == 6
    assert result["frames"] == 7


def test_a_run_has_every_reported_metric(result: dict[str, Any]) -> None:
    check_keys(result)
    assert all(math.isfinite(result[key]) for key in METRICS)
    assert result["success"] is not bool(result["duplicated"])
    assert result["objects"] > 3
    assert result["energy_j"] == 0  # nobody carries a free camera
    json.dumps(result)


def test_same_spec_same_result(result: dict[str, Any]) -> None:
    again = ArmExperiment.run(RunSpec("random", "table", 1000, FREE, steps=100, seconds=0.19))
    clocks = ("decision_ms",)
    assert {k: v for k, v in again.items() if k not in clocks} == {
        k: v for k, v in result.items() if k not in clocks
    }


def test_a_run_draws_its_map(tmp_path: Path) -> None:
    (spec,) = ArmExperiment(
        ("stationary",),
        ("table",),
        1,
        seconds=0.1,
        env_id=FREE,
        seeds="train",
        pictures=tmp_path / "maps",
    ).specs()
    found = ArmExperiment.run(spec)
    assert found["success"]
    assert found["path_length_m"] == 0
    assert cv2.imread(str(tmp_path / "maps" / "table_stationary_0.png")) is not None


def test_runs_of_one_scene_differ_in_light_and_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def judge(world: Any, rule: Any) -> Any:
        seen.append((world.episode, world.scene.seed))
        return judge_episode(world, rule)

    monkeypatch.setattr("ms_slam_experiments.arm_experiment.judge_episode", judge)
    specs = ArmExperiment(
        ("stationary",), ("table",), 2, seconds=0.1, env_id=FREE, seeds="train", same_scene=1000
    ).specs()
    for spec in specs:
        ArmExperiment.run(spec)
    (one, seed), (other, same_seed) = seen
    assert seed == same_seed == 1000
    assert one.noise_seed != other.noise_seed
    np.testing.assert_array_equal(one.trajectory_truth, other.trajectory_truth)
    colours = [episode.last_frame.color.astype(float) for episode in (one, other)]
    apart = cv2.blur(colours[0], (9, 9)) - cv2.blur(colours[1], (9, 9))
    assert 0.3 < np.abs(apart).mean() < 30  # other light, the same things


def test_the_default_is_the_paper_s_experiment() -> None:
    specs = ArmExperiment().specs()
    assert len(specs) == 4 * 4 * 10
    assert {spec.scene for spec in specs} == {"window", "table", "wall", "carpet"}
    assert {spec.env_id for spec in specs} == {"MSActiveSLAM-v0"}
    assert {spec.seconds for spec in specs} == {60.0}
    assert sorted({spec.seed for spec in specs}) == list(range(2000, 2010))
    # the time limit of the environment never comes before the end of the run
    assert all(spec.steps >= spec.seconds * 30 for spec in specs)
    assert all(spec.options["lost_patience"] > spec.steps for spec in specs)


def row(scene: str, planner: str, success: bool, lost: bool = False) -> dict[str, Any]:
    numbers = {key: 1.0 for key in METRICS if metric(key).unit != "flag"}
    flags = {"success": success, "success_tracked": success and not lost, "lost": lost}
    spec = {"scene": scene, "planner": planner}
    return {"spec": spec, "result": numbers | flags, "error": None, "commit": "c"}


ROWS = [
    *(row("carpet", "random", False) for _ in range(10)),
    *(row("carpet", "greedy", k < 5, lost=k == 0) for k in range(10)),
    *(row("wall", planner, True) for planner in ("random", "greedy")),
    row("table", "random", True),
    {"spec": {"scene": "table", "planner": "greedy"}, "result": None, "error": "x", "commit": "c"},
]


def test_shares_have_wilson_intervals() -> None:
    lines: Any = ArmExperiment().tables(ROWS)[0].rows
    random, greedy = lines[:2]
    # z = 1.959964, n = 10, p = 1/2: centre 1/2, half width z sqrt(1/40 + z^2 / 400) / (1 + z^2/10)
    z = 1.959964
    half = z * math.sqrt(1 / 40 + z**2 / 400) / (1 + z**2 / 10)
    assert greedy["success"].value == 0.5
    assert greedy["success"].low == pytest.approx(0.5 - half, abs=1e-6)
    assert greedy["success_tracked"].value == 0.4
    assert random["success"].value == 0.0


def test_the_comparison_names_the_better_planner() -> None:
    better = {line["scene"]: line["better_planner"] for line in compare(ROWS)}
    assert better == {"carpet": "greedy", "wall": "equal", "table": None}
    text = ArmExperiment().tables(ROWS)[1].as_markdown()
    line = "| carpet | 0 of 10 | 5 of 10 | greedy | greedy better: random 0 of 10, greedy 5 of 10 |"
    assert line in text


def test_a_map_without_objects_has_no_share_and_the_chart_no_bar() -> None:
    empty = row("wall", "greedy", True)
    empty["result"]["worst_apart_share"] = math.nan
    assert "| - |" in ArmExperiment().tables([empty])[0].as_markdown()
    (chart,) = ArmExperiment().charts(ROWS)
    assert [len(series.y) for series in chart.panels[0].series] == [3, 3]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"seconds": 0.0}, "seconds = 0.0 is outside"),
        ({"scenes": ("moon",)}, "moon"),
        ({"planners": ("psychic",)}, "psychic"),
        ({"embodiment": "balloon"}, "balloon"),
        ({"episodes": 0}, "episodes = 0"),
    ],
)
def test_bad_input_is_refused_before_anything_runs(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ArmExperiment(**fields).prepare()
    with pytest.raises(InputError, match="share"):
        ConsistencyRule(share=2)


def test_the_check_of_the_rule_counts_by_distance() -> None:
    rows = [
        {
            "spec": {"offset_m": offset},
            "result": {"success": success, "worst_apart_share": share},
            "error": None,
        }
        for offset, success, share in ((0.1, False, 0.4), (0.1, True, 0.0), (0.0, True, math.nan))
    ]
    (table,) = DuplicateObjects().tables(rows)
    assert [line["offset_m"] for line in table.rows] == [0.0, 0.1]
    assert "| 0 | 1 | 100 [21, 100] | - |" in table.as_markdown()
    assert "| 10 | 2 | 50 [9.5, 91] | 20 [0, 40] |" in table.as_markdown()


def test_one_good_map_is_enough_for_no_distance() -> None:
    specs = DuplicateObjects(scenes=("wall",), episodes=1).specs()
    assert [(s.offset_m, s.axis) for s in specs[:2]] == [(0.0, 0), (0.03, 0)]
    assert len(specs) == 1 + 4 * 3
