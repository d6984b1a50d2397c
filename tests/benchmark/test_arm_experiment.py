"""The robot experiment: real runs, short ones, and its report on made-up ones."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import pytest

from ms_slam_env.benchmark import arm_experiment_report as report
from ms_slam_env.benchmark import map_consistency_check
from ms_slam_env.benchmark.arm_experiment import Arguments, RunSpec, main, run
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.consistency import ConsistencyRule

FREE = "MSActiveSLAM-FreeCamera-v0"
MADE_BY = {"command": "x", "versions": {"ms-slam-env": "0"}, "cpu": "y"}


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return run(RunSpec("random", "table", 1000, FREE, steps=100, seconds=0.19))


def test_a_run_ends_after_its_seconds(result: dict[str, Any]) -> None:
    assert result["time_s"] == pytest.approx(0.2)
    assert result["steps"] == 6
    assert result["frames"] == 7


def test_a_run_has_every_reported_metric(result: dict[str, Any]) -> None:
    for column in (*report.SHARES, *report.MEDIANS):
        assert math.isfinite(result[column.metric])
    assert result["success"] is not bool(result["duplicated"])
    assert result["objects"] > 3
    assert result["energy_j"] == 0  # nobody carries a free camera
    json.dumps(result)


def test_same_spec_same_result(result: dict[str, Any]) -> None:
    again = run(RunSpec("random", "table", 1000, FREE, steps=100, seconds=0.19))
    clocks = ("decision_ms",)
    assert {k: v for k, v in again.items() if k not in clocks} == {
        k: v for k, v in result.items() if k not in clocks
    }


def test_the_experiment_writes_its_files_and_resumes(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["--planners", "stationary", "--scenes", "table", "--episodes", "1"]
    arguments += ["--seconds", "0.1", "--env-id", FREE, "--seeds", "train", "--workers", "1"]
    assert main([*arguments, "--out", str(out)]) == 0
    results = json.loads((out / "results.json").read_text())
    assert len(results["runs"]) == 1
    assert results["runs"][0]["result"]["success"]
    assert results["runs"][0]["result"]["path_length_m"] == 0
    assert results["rule"]["apart_m"] == ConsistencyRule().apart_m
    for picture in ("arm_experiment.png", "maps/table_stationary_0.png"):
        assert cv2.imread(str(out / picture)) is not None
    assert "| table | stationary | 1 | 100 [21, 100] |" in (out / "table.md").read_text()
    before = (out / "episodes.jsonl").read_text()
    assert main([*arguments, "--out", str(out)]) == 0
    assert (out / "episodes.jsonl").read_text() == before  # nothing was left to run


def test_the_default_is_the_paper_s_experiment() -> None:
    specs = Arguments().specs()
    assert len(specs) == 4 * 4 * 10
    assert {spec.scene for spec in specs} == {"window", "table", "wall", "carpet"}
    assert {spec.env_id for spec in specs} == {"MSActiveSLAM-v0"}
    assert {spec.seconds for spec in specs} == {60.0}
    assert sorted({spec.seed for spec in specs}) == list(range(2000, 2010))
    # the time limit of the environment never comes before the end of the run
    assert all(spec.steps >= spec.seconds * 30 for spec in specs)
    assert all(spec.options["lost_patience"] > spec.steps for spec in specs)


def row(scene: str, planner: str, success: bool, lost: bool = False) -> dict[str, Any]:
    numbers = {column.metric: 1.0 for column in report.MEDIANS}
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
    success = report.summarise(ROWS)["carpet", "greedy"]["success"]
    # z = 1.959964, n = 10, p = 1/2: centre 1/2, half width z sqrt(1/40 + z^2 / 400) / (1 + z^2/10)
    z = 1.959964
    half = z * math.sqrt(1 / 40 + z**2 / 400) / (1 + z**2 / 10)
    assert success.value == 0.5
    assert success.low == pytest.approx(0.5 - half, abs=1e-6)
    assert success.high == pytest.approx(0.5 + half, abs=1e-6)
    assert report.summarise(ROWS)["carpet", "greedy"]["success_tracked"].value == 0.4
    assert report.summarise(ROWS)["carpet", "random"]["success"].value == 0.0


def test_the_comparison_names_the_better_planner() -> None:
    comparison = report.compare(ROWS)
    assert comparison["carpet"]["greedy"] == (5, 10)
    assert comparison["carpet"]["winner"] == "greedy"
    assert comparison["wall"]["winner"] == "equal"
    assert comparison["table"]["winner"] is None
    text = report.as_text(ROWS, 60, MADE_BY)
    line = "| carpet | 0 of 10 | 5 of 10 | greedy | greedy better: random 0 of 10, greedy 5 of 10 |"
    assert line in text


def test_a_map_without_objects_has_no_share() -> None:
    empty = row("wall", "greedy", True)
    empty["result"]["worst_share"] = math.nan
    assert math.isnan(report.summarise([empty])["wall", "greedy"]["worst_share"].value)
    assert "| - |" in report.cells_table([empty])


def test_the_figure_needs_no_complete_grid(tmp_path: Path) -> None:
    path = report.save_figure(report.summarise(ROWS), tmp_path / "figure.png")
    assert cv2.imread(str(path)) is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seconds", "0"], "seconds = 0.0 is outside"),
        (["--scenes", "moon"], "moon"),
        (["--planners", "psychic"], "psychic"),
        (["--embodiment", "balloon"], "balloon"),
        (["--rule.share", "2"], "share"),
        (["--episodes", "0"], "episodes = 0"),
    ],
)
def test_bad_input_is_refused_before_anything_runs(
    arguments: list[str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        main([*arguments, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_the_check_of_the_rule_counts_by_distance() -> None:
    rows = [
        {
            "spec": {"offset_m": offset},
            "result": {"failed": failed, "worst_share": share, "duplicated": {}},
            "error": None,
        }
        for offset, failed, share in ((0.1, True, 0.4), (0.1, False, 0.0), (0.0, False, math.nan))
    ]
    summary = map_consistency_check.summarise(rows)
    assert list(summary) == [0.0, 0.1]
    assert summary[0.1]["failed"].value == 0.5
    assert summary[0.1]["worst_share"].value == pytest.approx(0.2)
    assert "| 0 | 1 | 0 [0, 79] | - |" in map_consistency_check.as_table(rows)


def test_one_good_map_is_enough_for_no_distance() -> None:
    specs = map_consistency_check.Arguments(scenes=("wall",), episodes=1).specs()
    assert [(s.offset_m, s.axis) for s in specs[:2]] == [(0.0, 0), (0.03, 0)]
    assert len(specs) == 1 + 4 * 3


@pytest.mark.parametrize("offsets", [(), (-1.0,), (math.inf,)])
def test_bad_distances_are_refused(offsets: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="offsets_cm"):
        map_consistency_check.Arguments(offsets_cm=offsets)
