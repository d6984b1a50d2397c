"""Tables, matrices and figures from rows of known content."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ms_slam_env.benchmark import planner_benchmark, planner_report, step_size, table_two
from ms_slam_env.benchmark.figures import colours, labels, save_planner_figures
from ms_slam_env.benchmark.planner_benchmark import PlannerBenchmark, write_report
from ms_slam_env.benchmark.table import format_interval, format_number, markdown_table
from ms_slam_env.errors import InputError
from ms_slam_env.report.records import Row, spec_key
from ms_slam_env.report.statistics import Interval

CONFIG = PlannerBenchmark(planners=("random", "greedy"), scenes=("table", "wall"), episodes=3)


def result(score: float) -> dict[str, Any]:
    columns = (*planner_report.HEADLINE, *planner_report.DETAILS)
    metrics: dict[str, Any] = {column.metric: score for column in columns}
    return {**metrics, "lost": score < 0.3, "ate_over_time": [0.001, 0.002, score]}


def rows_of(config: PlannerBenchmark) -> list[Row]:
    """Greedy scores 0.5, 0.6, 0.7 by seed, random 0.1, 0.2, 0.3; the same in every scene."""
    rows = []
    for spec in config.specs():
        score = 0.1 * (1 + spec.seed - 2000) + (0.4 if spec.planner == "greedy" else 0.0)
        rows.append(
            {
                "key": spec_key(spec),
                "spec": vars(spec),
                "result": result(score),
                "error": None,
                "commit": "abc",
            }
        )
    return rows


def test_best_f_score_comes_first() -> None:
    summary = planner_report.summarise(rows_of(CONFIG))
    assert list(summary) == ["greedy", "random"]
    assert summary["greedy"]["f_score_5cm"].value == pytest.approx(0.6)
    assert summary["random"]["lost"].value == pytest.approx(2 / 3)


def test_failed_episodes_do_not_count() -> None:
    rows = rows_of(CONFIG)
    rows[0] = {**rows[0], "result": None, "error": "ValueError: x"}
    assert "| random | 5 |" in planner_report.planner_table(rows)
    assert planner_report.score_matrices(rows)["random"].shape == (2, 2)


def test_an_empty_map_has_no_rer_and_no_f_score() -> None:
    rows = rows_of(CONFIG)
    for row in rows:
        row["result"]["rer_m"] = float("nan")
    assert np.isnan(planner_report.summarise(rows)["greedy"]["rer_m"].value)


def test_score_matrix_has_episodes_by_scenes() -> None:
    matrix = planner_report.score_matrices(rows_of(CONFIG))["greedy"]
    np.testing.assert_allclose(matrix, [[0.5, 0.5], [0.6, 0.6], [0.7, 0.7]])


def test_report_writes_results_table_and_figures(tmp_path: Path) -> None:
    table = write_report(CONFIG, rows_of(CONFIG), tmp_path)
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["seeds"] == [2000, 2001, 2002]
    assert content["provenance"]["versions"]["ms-slam-env"]
    assert len(content["episodes"]) == 12
    assert (tmp_path / "table.md").read_text() == table
    assert table.index("| greedy | 6 |") < table.index("| random | 6 |")
    assert "### wall" in table
    assert "commit abc" in table
    names = {"planners.png", "f_score_ate.png", "ate_over_time.png"}
    assert names <= {path.name for path in tmp_path.iterdir()}


def test_without_rliable_the_rest_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(planner_report.statistics, "has_rliable", lambda: False)
    table = write_report(CONFIG, rows_of(CONFIG), tmp_path)
    assert "Across scenes" not in table
    assert "ms-slam-env[statistics]" in capsys.readouterr().err


def test_a_planner_has_the_same_colour_in_every_company() -> None:
    every = ["policy-features,path=a.zip", "mine:Planner", *planner_benchmark.DEFAULT_PLANNERS]
    together = colours(every)
    assert len(set(together.values())) == len(every)
    for planner in (every[0], *planner_benchmark.DEFAULT_PLANNERS):
        assert colours([planner])[planner] == together[planner]
    variants = colours(["greedy", "greedy,rho_I=0.3"])
    assert variants["greedy"] == together["greedy"] != variants["greedy,rho_I=0.3"]


def test_labels_are_as_long_as_it_takes_to_tell_planners_apart() -> None:
    path = "policy-features,path=docs/results/train/policy.zip"
    assert labels(["random", path]) == {"random": "random", path: "policy-features"}
    assert labels(["greedy", "greedy,rho_I=0.3,file=a/b"]) == {
        "greedy": "greedy",
        "greedy,rho_I=0.3,file=a/b": "greedy\nrho_I=0.3\nfile=b",
    }


def test_no_finished_episode_no_figure(tmp_path: Path) -> None:
    rows = [{**row, "result": None, "error": "x"} for row in rows_of(CONFIG)]
    assert save_planner_figures(rows, tmp_path) == []


def test_every_planner_starts_from_the_same_seeds() -> None:
    seeds: dict[str, list[tuple[str, int]]] = {}
    for spec in CONFIG.specs():
        seeds.setdefault(spec.planner, []).append((spec.scene, spec.seed))
    assert seeds["random"] == seeds["greedy"]
    assert len(set(seeds["random"])) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"planners": ("nonsense",)}, "unknown planner 'nonsense'; valid choices: .*greedy"),
        ({"planners": ()}, "no planner"),
        ({"planners": ("random", "random")}, "twice"),
        ({"planners": ("greedy,foo=1",)}, "unknown option of planner greedy 'foo'.*rho_I"),
        ({"planners": ("greedy,rho_I",)}, "not option=value"),
        ({"planners": ("os:path",)}, "not a subclass"),
        ({"planners": ("nowhere:Planner",)}, "cannot be loaded"),
        ({"scenes": ("mars",)}, "unknown scene 'mars'; valid choices: living_room"),
        ({"scenes": ("missing.glb",)}, "mesh file 'missing.glb' does not exist"),
        ({"scenes": ("pyproject.toml",)}, "unknown scene"),
        ({"seeds": "exam"}, "unknown split of seeds 'exam'; valid choices: train"),
        ({"episodes": 0}, "episodes = 0"),
        ({"episodes": 101}, "outside \\[1, 100\\]"),
        ({"env_id": "CartPole-v1"}, "valid choices: MSActiveSLAM"),
        ({"options": ("lookahead",)}, "not name=value"),
        ({"options": ("lookahed.reference=live",)}, "lookahed'; valid choices: .*lookahead"),
        ({"options": ("lookahead.reference=dead",)}, "valid choices: live, predicted"),
        ({"options": ("scene=table",)}, "the benchmark sets it"),
        ({"options": ("step_m=1",)}, "the benchmark sets it"),
        ({"steps": 0}, "steps"),
        ({"step_m": float("nan")}, "step_m"),
    ],
)
def test_bad_configurations_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PlannerBenchmark(**options)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0.0123, 2, "0.012"), (123.4, 2, "123"), (0.0, 2, "0"), (9.96, 2, "10.0"), (-1.5, 2, "-1.5")],
)
def test_numbers_have_significant_digits(value: float, digits: int, text: str) -> None:
    assert format_number(value, digits) == text


def test_table_is_markdown() -> None:
    text = markdown_table(["a", "b"], [["x", format_interval(Interval(1.0, 0.5, 2.0), 10)]])
    assert text == "| a | b |\n| --- | ---: |\n| x | 10 [5.0, 20] |\n"


def test_step_size_summary_separates_sizes(tmp_path: Path) -> None:
    specs = step_size.Arguments(
        planners=("random",), scenes=("table",), sizes=(2, 10), episodes=3
    ).specs()
    rows = [
        {"spec": vars(spec), "error": None, "result": result(spec.step_deg / 20)} for spec in specs
    ]
    summary = step_size.summarise(rows)
    assert list(summary) == [("random", 2), ("random", 10)]
    assert summary["random", 2]["lost"].value == 1
    assert summary["random", 10]["lost"].value == 0
    assert summary["random", 10]["ate_m"].value == 0.5
    step_size.save_figure(summary, tmp_path / "a.png")
    assert "| random | 10 | 0 [0, 56] | 500 [500, 500] |" in step_size.as_table(summary)


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


def test_options_reach_the_episodes() -> None:
    texts = ("lookahead.reference=live", "lookahead.scale=1.0", "lost_patience=3")
    spec = PlannerBenchmark(options=texts).specs()[0]
    assert spec.options == {"lookahead": {"reference": "live", "scale": 1.0}, "lost_patience": 3}
    assert spec_key(spec) != spec_key(PlannerBenchmark().specs()[0])


def test_seed_list_is_the_start_of_the_split() -> None:
    assert planner_benchmark.seed_list("validation", 2) == [1000, 1001]
