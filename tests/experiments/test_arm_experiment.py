"""The robot experiment: real runs, short ones, and its tables on made-up ones."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from ms_slam_experiments.arm_experiment import (
    METRICS,
    ArmExperiment,
    compare,
    judge_episode,
)
from ms_slam_experiments.shared.duplicate_objects import ConsistencyRule

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import metric

FREE = "MSActiveSLAM-FreeCamera-v0"


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


def test_the_comparison_names_the_better_planner() -> None:
    better = {line["scene"]: line["better_planner"] for line in compare(ROWS)}
    assert better == {"carpet": "greedy", "wall": "not shown", "table": None}
    text = ArmExperiment().tables(ROWS)[1].as_markdown()
    line = "| carpet | 0 of 10 | 5 of 10 | 0.033 | greedy | greedy better: random 0 of 10, greedy 5"
    assert line in text
    few = [*(row("wall", "random", k < 5) for k in range(10)),
           *(row("wall", "greedy", k < 7) for k in range(10))]  # fmt: skip
    (line_of_few,) = compare(few)
    assert line_of_few["better_planner"] == "not shown"
    assert line_of_few["fisher_p"] == pytest.approx(0.65, abs=0.005)


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
