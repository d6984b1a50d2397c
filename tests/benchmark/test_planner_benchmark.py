"""The planner benchmark and step sizes: tables, charts and files from rows of known content."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ms_slam_experiments.paper_table2 import METRICS, PaperTable2
from ms_slam_experiments.step_size import StepSize

from ms_slam_env.benchmark.episodes import seed_list, short_planner_names
from ms_slam_env.benchmark.planner_tables import (
    DETAILS,
    HEADLINE,
    from_the_same_start,
    policies_together,
    score_matrices,
    with_privilege,
)
from ms_slam_env.benchmark.planners import PlannerBenchmark
from ms_slam_env.benchmark.rows import write_all
from ms_slam_env.env.planners import is_privileged
from ms_slam_env.errors import InputError
from ms_slam_env.report.records import Row, spec_key
from ms_slam_env.report.results import read_results
from ms_slam_env.report.statistics import Interval, share_interval
from ms_slam_env.tasks import OWN

CONFIG = PlannerBenchmark(planners=("random", "greedy"), scenes=("table", "wall"), episodes=3)


def result(score: float) -> dict[str, Any]:
    metrics: dict[str, Any] = dict.fromkeys((*HEADLINE, *DETAILS), score)
    curve = {"looks_at_steps": [0, 5], "f_score_5cm_over_steps": [0.1, score]}
    losses = {"losses": 2, "losses_not_recovered": int(score < 0.3)}
    over_time = {"ate_over_steps": [0.001, score]}
    return {**metrics, **curve, **losses, **over_time, "lost": score < 0.3, "energy_j": 0.0}


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
    lines: Any = CONFIG.tables(rows_of(CONFIG))[0].rows
    assert [line["planner"] for line in lines] == ["greedy", "random"]
    assert lines[0]["f_score_5cm"].value == pytest.approx(0.6)
    assert lines[1]["lost"].value == pytest.approx(2 / 3)


def test_failed_episodes_do_not_count() -> None:
    rows = rows_of(CONFIG)
    rows[0] = {**rows[0], "result": None, "error": "ValueError: x"}
    text = CONFIG.tables(rows)[0].as_markdown()
    assert "| random | 5 |" in text
    assert "| greedy | 5 |" in text  # in pairs
    assert score_matrices(rows)["random"].shape == (2, 2)


def test_rows_of_a_time_without_errors_over_steps_are_left_out_of_that_chart() -> None:
    rows = rows_of(CONFIG)
    for row in rows:
        if row["spec"]["planner"] == "random":
            del row["result"]["ate_over_steps"]
    assert [series.name for series in CONFIG.charts(rows)[-1].panels[0].series] == ["greedy"]
    for row in rows:
        row["result"].pop("ate_over_steps", None)
    assert [chart.name for chart in CONFIG.charts(rows)][-1] == "f_score_ate"


def test_an_empty_map_has_no_rer_and_no_f_score() -> None:
    rows = rows_of(CONFIG)
    for row in rows:
        row["result"]["rer_m"] = float("nan")
    line: Any = CONFIG.tables(rows)[1].rows[0]
    assert np.isnan(line["rer_m"].value)


def test_score_matrix_has_episodes_by_scenes() -> None:
    matrix = score_matrices(rows_of(CONFIG))["greedy"]
    np.testing.assert_allclose(matrix, [[0.5, 0.5], [0.6, 0.6], [0.7, 0.7]])


def test_results_table_and_figures_are_written(tmp_path: Path) -> None:
    write_all(CONFIG, rows_of(CONFIG), tmp_path)
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["kind"] == "planners"
    assert content["seeds"] == [2000, 2001, 2002]
    assert content["summary"]["greedy"]["f_score_5cm"]["value"] == pytest.approx(0.6)
    assert content["provenance"]["versions"]["ms-slam-env"]
    assert len(content["episodes"]) == 12
    table = (tmp_path / "table.md").read_text()
    assert table.index("| greedy | 6 |") < table.index("| random | 6 |")
    assert "### wall" in table
    assert "commit abc" in table
    names = {"f_score_over_steps.png", "planners.png", "f_score_ate.png", "ate_over_steps.png"}
    assert names <= {path.name for path in tmp_path.iterdir()}
    again = read_results(tmp_path / "results.json")
    assert [t.as_markdown() for t in again.tables] == [
        t.as_markdown() for t in CONFIG.tables(rows_of(CONFIG))
    ]
    assert again.charts[0].panels[0].series[0].name == "greedy"


def test_losses_count_together_and_energy_only_where_something_was_moved() -> None:
    rows = rows_of(CONFIG)
    table = CONFIG.tables(rows)[0]
    columns = [column.name for column in table.columns]
    assert columns[columns.index("lost") + 1 :][:2] == ["losses", "not_recovered_share"]
    assert "energy_j" not in columns
    lines: Any = {line["planner"]: line for line in table.rows}
    assert lines["random"]["losses"] == 12
    assert lines["random"]["not_recovered_share"].value == pytest.approx(4 / 12)  # scores .1, .2
    assert lines["greedy"]["not_recovered_share"].value == 0
    rows[0]["result"]["energy_j"] = 1.0
    assert "energy_j" in [column.name for column in CONFIG.tables(rows)[0].columns]


def test_planners_that_see_the_truth_are_marked(tmp_path: Path) -> None:
    config = replace(CONFIG, planners=("random", "foresight,tried=4", "oracle"))
    written = write_all(config, rows_of(config), tmp_path)
    assert {table.title for table in written.tables if "privileged" in table.rows[0]} >= {
        *("", "Details", "Across scenes", "table", "Share of pairs, by final F-score"),
    }
    table = read_results(tmp_path / "results.json").tables[0]
    assert [column.name for column in table.columns[:2]] == ["planner", "privileged"]
    assert {line["planner"]: line["privileged"] for line in table.rows} == {
        "random": False,
        "foresight,tried=4": True,
        "oracle": True,
    }
    assert "| oracle | yes | 6 |" in table.as_markdown()
    assert with_privilege(table) is table
    (fair, *_) = write_all(CONFIG, rows_of(CONFIG), tmp_path).tables
    assert "privileged" not in [column.name for column in fair.columns]


def test_no_name_of_a_record_is_imported_to_mark_it() -> None:
    """``antigravity`` opens a browser; a class that is loaded already is looked at."""
    assert is_privileged("antigravity:fly") is None
    assert "antigravity" not in sys.modules
    assert is_privileged("no such planner") is None
    assert is_privileged("agent-room (5 policies)") is is_privileged("nbv,path=x:y") is False
    assert is_privileged("ms_slam_env.env.planners:PrivilegedPlanner,a=1") is True
    assert is_privileged("ms_slam_env.env.planners:PLANNERS.find") is None


def test_every_planner_is_compared_with_every_other() -> None:
    tables = {table.title: table for table in CONFIG.tables(rows_of(CONFIG))}
    assert tables["Share of pairs, by area under the F-score"].rows
    table = tables["Share of pairs, by final F-score"]
    lines: Any = table.rows
    assert [line["planner"] for line in lines] == ["greedy", "random"]
    assert (lines[0]["greedy"], lines[0]["random"].value) == (None, 1.0)
    assert lines[1]["greedy"].value == 0.0


def test_from_the_same_start_pairs_are_compared_one_by_one() -> None:
    areas = {"a": [0.5, 0.9, 0.3, 0.4], "b": [0.4, 0.8, 0.2, 0.4], "c": [0.9, 0.1, 0.9, 0.9]}
    rows: list[Row] = [
        {
            "spec": {"planner": name, "scene": "table", "seed": 2000 + k},
            "result": {"f_score_5cm_area": area},
            "error": None,
        }
        for name, of in areas.items()
        for k, area in enumerate(of)
    ]
    (table,) = from_the_same_start(rows)
    lines: Any = {line["planner"]: line for line in table.rows}
    assert list(lines) == ["c", "a", "b"]
    assert lines["a"]["b"] == share_interval([True] * 3)  # the fourth is equal
    assert lines["b"]["a"].value == 0
    assert lines["c"]["a"] == share_interval([True, False, True, True])
    assert lines["a"]["a"] is None
    assert "4 starts" in table.note
    assert from_the_same_start(rows[:4]) == []
    (fewer,) = from_the_same_start(rows[::-1][1:])  # c has not finished the last
    assert "3 starts" in fewer.note
    del rows[0]["result"]["f_score_5cm_area"]
    assert "3 starts" in from_the_same_start(rows)[0].note
    assert "Share of starts, by area under the F-score" in [
        t.title for t in CONFIG.tables(rows_of(CONFIG))
    ]


def test_policies_of_one_training_are_judged_together_too() -> None:
    scores = {"nbv": 0.5, "agent,path=a": 0.3, "agent,path=b": 0.8, "agent": 0.7, "x,path=c": 0.1}
    rows: list[Row] = [
        {"spec": {**row["spec"], "planner": name}, "result": result(score), "error": None}
        for row in rows_of(PlannerBenchmark(planners=("random",), scenes=("table", "wall")))
        for name, score in scores.items()
    ]
    tables = {table.title: table for table in CONFIG.tables(rows)}
    lines: Any = tables["Policies of each training pooled: Share of pairs, by final F-score"].rows
    found = {line["planner"]: line for line in lines}
    assert set(found) == {"nbv", "agent (3 policies)", "x,path=c"}
    of_trainings = found["agent (3 policies)"]["nbv"]
    assert of_trainings.value == pytest.approx(2 / 3)
    assert (of_trainings.low, of_trainings.high) == pytest.approx((0, 1))  # by one policy and all
    assert len(tables["Share of pairs, by final F-score"].rows) == 5
    medians: Any = {
        line["planner"]: line for line in tables["Policies of each training pooled"].rows
    }
    assert medians["agent (3 policies)"]["episodes"] == 3 * medians["nbv"]["episodes"]
    assert medians["agent (3 policies)"]["f_score_5cm"].value == pytest.approx(0.7)
    over_steps = CONFIG.charts(rows)[0].panels[0]
    assert {series.name for series in over_steps.series} == {"nbv", "agent (3 policies)", "x"}
    assert not policies_together(
        [row for row in rows if row["spec"]["planner"] in ("nbv", "agent")]
    )


def test_policies_in_several_folders_are_of_several_trainings() -> None:
    names = ["p,path=x/1", "p,path=x/2", "p,path=y/1", "p,path=y/2,recovery=true", "p"]
    rows: list[Row] = [{"spec": {"planner": name}, "result": {}, "error": None} for name in names]
    assert [row["spec"]["planner"] for row in policies_together(rows)] == [
        *("p,path=x (2 policies)",) * 2,
        *names[2:],
    ]


def test_policies_that_lie_where_their_trainings_left_them_are_told_apart() -> None:
    names = [f"p,path=runs/{o}/{seed}/latest" for o in ("held", "map") for seed in (1, 2)]
    rows: list[Row] = [{"spec": {"planner": name}, "result": {}, "error": None} for name in names]

    def found(rows: list[Row]) -> list[str]:
        return [row["spec"]["planner"] for row in policies_together(rows)]

    assert found(rows) == [f"p,path=runs/{o} (2 policies)" for o in ("held", "map") for _ in "12"]
    assert found(rows[:2]) == ["p (2 policies)"] * 2


def test_a_policy_that_finished_nothing_is_none_of_its_training() -> None:
    rows: list[Row] = [
        {
            "spec": {**row["spec"], "planner": f"p,path=a/{seed}"},
            "result": row["result"] if seed < 2 else None,
            "error": None if seed < 2 else "x",
        }
        for row in rows_of(PlannerBenchmark(planners=("random",), scenes=("table", "wall")))
        for seed in range(3)
    ]
    tables = {table.title: table for table in CONFIG.tables(rows)}
    (line,) = tables["Policies of each training pooled"].rows
    assert line["planner"] == "p (2 policies)"
    for row in rows:
        if row["spec"]["planner"] == "p,path=a/1":
            row["result"], row["error"] = None, "x"
    assert not [title for title in (t.title for t in CONFIG.tables(rows)) if "pooled" in title]


def test_planners_are_compared_by_what_the_reward_says_too() -> None:
    rows = rows_of(CONFIG)
    for row in rows:
        row["result"]["return"] = -row["result"]["f_score_5cm"]
    tables = {table.title: table for table in CONFIG.tables(rows)}
    lines: Any = tables["Share of pairs, by return"].rows
    assert [line["planner"] for line in lines] == ["random", "greedy"]
    assert lines[0]["greedy"].value == 1.0


def test_a_task_says_what_is_not_given() -> None:
    arm = PlannerBenchmark(task="arm", planners=("random",)).specs()
    assert {spec.env_id for spec in arm} == {"MSActiveSLAM-v0"}
    assert {spec.scene for spec in arm} == {"window", "table", "wall", "carpet"}
    assert {spec.steps for spec in arm} == {1800}
    assert len(arm) == 40
    few = PlannerBenchmark(task="disturbed", scenes=("table",), steps=7, step_m=0.05, episodes=2)
    spec = few.specs()[0]
    assert (spec.task, spec.steps, spec.step_m, spec.step_deg) == ("disturbed", 7, 0.05, 12)
    assert len(few.specs()) == 2 * len(few.planners)


def test_all_tasks_are_the_leaderboard() -> None:
    board = PlannerBenchmark(task="all", planners=("random", "greedy"), scenes=("table",))
    specs = board.specs()
    assert {(spec.task, spec.seed) for spec in specs} == {
        (task, seed) for task in OWN for seed in range(2000, 2025)
    }
    rows = [{"spec": vars(s), "result": result(0.5), "error": None} for s in specs]
    titles = [table.title for table in board.tables(rows)]
    assert [title for title in titles if title.endswith("over all scenes")] == [
        f"{task}: over all scenes" for task in OWN
    ]
    assert {chart.name for chart in board.charts(rows)} > {"home_planners", "arm_planners"}
    assert board.content(rows) == {"seeds": list(range(2000, 2025))}


def test_names_are_as_long_as_it_takes_to_tell_planners_apart() -> None:
    path = "policy,path=docs/results/train/policy.zip"
    assert short_planner_names(["random", path]) == {"random": "random", path: "policy"}
    assert short_planner_names(["greedy", "greedy,rho_I=0.3,file=a/b"]) == {
        "greedy": "greedy",
        "greedy,rho_I=0.3,file=a/b": "greedy, rho_I=0.3, file=b",
    }
    apart = {"policy,path=x/a/1": "policy, path=a/1", "policy,path=x/b/1": "policy, path=b/1"}
    assert short_planner_names(apart) == apart
    farther = ["policy,path=/r/x/a/1", "policy,path=/r/y/a/1"]
    assert list(short_planner_names(farther).values()) == [
        "policy, path=x/a/1",
        "policy, path=y/a/1",
    ]
    assert short_planner_names(["p,a=/r", "p,a=r"]) == {"p,a=/r": "p, a=/r", "p,a=r": "p, a=r"}


def test_every_planner_starts_from_the_same_seeds() -> None:
    seeds: dict[str, list[tuple[str, int]]] = {}
    for spec in CONFIG.specs():
        seeds.setdefault(spec.planner, []).append((spec.scene, spec.seed))
    assert seeds["random"] == seeds["greedy"]
    assert len(set(seeds["random"])) == 6


def test_step_sizes_have_a_line_each() -> None:
    experiment = StepSize(planners=("random",), scenes=("table",), sizes=(2, 10), episodes=3)
    rows = [
        {"spec": vars(spec), "error": None, "result": result(spec.step_deg / 20)}
        for spec in experiment.specs()
    ]
    (table,) = experiment.tables(rows)
    assert table.rows[0]["lost"] == Interval(1.0, pytest.approx(0.44, abs=0.01), 1.0)
    assert "| random | 10 | 0 [0, 56] | 500 [500, 500] |" in table.as_markdown()
    (chart,) = experiment.charts(rows)
    assert [panel.series[0].x for panel in chart.panels] == [[2, 10]] * 4


def test_options_reach_the_episodes() -> None:
    texts = ("lookahead.reference=live", "lookahead.scale=1.0", "lost_patience=3")
    spec = PlannerBenchmark(options=texts).specs()[0]
    assert spec.options == {"lookahead": {"reference": "live", "scale": 1.0}, "lost_patience": 3}
    assert spec_key(spec) != spec_key(PlannerBenchmark().specs()[0])


def test_seed_list_is_the_start_of_the_split() -> None:
    assert seed_list("validation", 2) == [1000, 1001]


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


def test_one_long_line_does_not_squeeze_the_others() -> None:
    rows = rows_of(CONFIG)
    for row in rows:
        is_long = row["spec"]["planner"] == "random" and row["spec"]["seed"] == 2001
        steps = 90 if is_long else 3
        row["result"] |= {"looks_at_steps": list(range(0, 5 * steps, 5))}
        row["result"] |= {"f_score_5cm_over_steps": [0.1] * steps, "ate_over_steps": [0.1] * steps}
    for chart in (CONFIG.charts(rows)[0], CONFIG.charts(rows)[-1]):
        assert chart.caption.endswith("One goes on, cut here.")
        for series in chart.panels[0].series:
            assert max(series.x) == 10
            assert len(series.x) == len(series.y) == len(series.low) == len(series.high)


@pytest.mark.parametrize(
    ("more", "length"),
    [
        ({}, "of at most 100 steps of 12 cm / 12 deg"),
        ({"task": "arm"}, "of 60 simulated seconds in motions of 12 cm / 12 deg"),
        ({"task": "arm", "options": ("seconds=5",)}, "of 5 simulated seconds in motions of 12 cm"),
    ],
)
def test_the_table_says_how_long_an_episode_is(more: dict[str, Any], length: str) -> None:
    config = PlannerBenchmark(planners=("random", "greedy"), episodes=3, **more)
    assert length in config.tables(rows_of(config))[0].note


def test_seeds_of_ones_own_are_all_played() -> None:
    own = replace(CONFIG, seeds="7000-7002,8000", episodes=None)
    assert {spec.seed for spec in own.specs()} == {7000, 7001, 7002, 8000}
    assert own.content([])["seeds"] == [7000, 7001, 7002, 8000]
    assert replace(own, episodes=4).specs() == own.specs()
    with pytest.raises(InputError, match=r"episodes = 3, .*are 4: leave --episodes out"):
        replace(own, episodes=3).specs()
    with pytest.raises(InputError, match="split of seeds 'tests'; valid choices: train"):
        replace(own, seeds="tests").specs()
