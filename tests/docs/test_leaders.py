"""Who is to beat in each benchmark, and by how much."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from ms_slam_docs.leaders import leaders

from ms_slam_env.benchmark.planner_tables import PAIRS, with_privilege
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.report.results import Results, write_results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Column, Table, make_table

SCORES = {"oracle": 0.9, "nbv": 0.5, "belief": 0.7, "random": 0.1}
"""F-score of each planner; the area under it goes the other way, but for the oracle."""
CHANCE = Interval(0.6, 0.4, 0.8)


def tables_of(prefix: str = "", scores: dict[str, float] = SCORES) -> list[Table]:
    lines = [
        {
            "planner": name,
            "f_score_5cm": Interval(score, score - 0.05, score + 0.05),
            "f_score_5cm_area": Interval(1 - score if score < 0.9 else 1.0, 0, 1),
        }
        for name, score in scores.items()
    ]
    pairs = make_table(
        ["planner", Column("nbv", "improvement", "nbv")],
        [{"planner": "belief", "nbv": CHANCE}],
        f"{prefix}{PAIRS['f_score_5cm']}",
    )
    title = f"{prefix}over all scenes" if prefix else ""
    columns = ["planner", "f_score_5cm", "f_score_5cm_area"]
    return [make_table(columns, lines, title), make_table(["planner"], [], "Details"), pairs]


def written(path: Path, tables: list[Table], task: str = "room") -> Results:
    content = {"config": {"task": task}}
    return write_results(path, "planners", "Planners", "About.", tables, content=content)


@pytest.fixture
def room(tmp_path: Path) -> Results:
    return written(tmp_path / "results.json", tables_of())


def test_the_best_that_sees_no_truth_leads(room: Results) -> None:
    (line,) = leaders([room], "f_score_5cm", with_privilege).rows
    assert (line["task"], line["planner"], line["next"]) == ("room", "belief", "nbv")
    assert line["f_score_5cm"] == Interval(0.7, 0.7 - 0.05, 0.7 + 0.05)
    assert line["improvement"] == CHANCE
    (line,) = leaders([room], "f_score_5cm_area", with_privilege).rows
    assert (line["planner"], line["next"], line["improvement"]) == ("random", "nbv", None)


def test_several_tasks_of_one_result_have_a_line_each(tmp_path: Path) -> None:
    alone = {"nbv": 0.3}
    tables = [*tables_of("home: "), *tables_of("arm: ", alone)]
    lines = leaders([written(tmp_path / "results.json", tables, "all")], "f_score_5cm").rows
    assert [(line["task"], line["planner"]) for line in lines] == [
        ("home", "oracle"),
        ("arm", "nbv"),
    ]
    assert lines[1].get("next") is lines[1].get("improvement") is None
    assert (
        leaders([replace(room_of(tables), content={})], "f_score_5cm", with_privilege).rows[0][
            "improvement"
        ]
        == CHANCE
    )


def room_of(tables: list[Table]) -> Results:
    return Results("planners", "Planners", "", tables, [], [], "rows", {}, {})


def test_what_nobody_leads_is_refused(room: Results) -> None:
    with pytest.raises(InputError, match="unknown metric of planners 'ate_m'; valid choices: f_sc"):
        leaders([room], "ate_m")
    with pytest.raises(InputError, match="no planner without the truth has return in room"):
        leaders([room], "return")
    only = room_of(tables_of(scores={"oracle": 0.9}))
    with pytest.raises(InputError, match="no planner without the truth has f_score_5cm"):
        leaders([only], "f_score_5cm", with_privilege)


def test_pages_have_it_between_comments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(tmp_path / "docs/results/a/results.json", tables_of())
    page = tmp_path / "README.md"
    page.write_text("<!-- leaders: a by=f_score_5cm -->\n<!-- end -->\n")
    assert main(["docs", "--root", str(tmp_path)]) == 0
    assert "| room | belief | 70 [65, 75] | nbv | 60 [40, 80] |" in page.read_text()
    for what in ("a", "by=f_score_5cm", "a by=f_score_5cm by=return"):
        page.write_text(f"<!-- leaders: {what} -->\n<!-- end -->\n")
        assert main(["docs", "--root", str(tmp_path)]) == 2
        assert "must name folders of results and by=METRIC" in capsys.readouterr().err
