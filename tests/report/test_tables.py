"""Numbers, cells and tables as text; what the registry does not know is refused."""

from __future__ import annotations

import json
import math

import pytest

from ms_slam_env.errors import InputError
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import (
    Column,
    Grouping,
    format_interval,
    format_number,
    format_value,
    make_table,
    markdown_table,
    table_from_json,
)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0.0123, 2, "0.012"), (123.4, 2, "123"), (0.0, 2, "0"), (9.96, 2, "10.0"), (-1.5, 2, "-1.5")],
)
def test_numbers_have_significant_digits(value: float, digits: int, text: str) -> None:
    assert format_number(value, digits) == text


def test_table_is_markdown() -> None:
    text = markdown_table(["a", "b"], [["x", format_interval(Interval(1.0, 0.5, 2.0), 10)]])
    assert text == "| a | b |\n| --- | ---: |\n| x | 10 [5.0, 20] |\n"


def test_cells_cannot_break_out_of_a_markdown_table() -> None:
    table = make_table(["planner"], [{"planner": "a|b\nc"}])
    assert table.as_markdown().splitlines()[2:] == ["| a\\|b c |"]


def test_values_are_shown_in_the_unit_of_their_metric() -> None:
    assert format_value(0.0123, "ate_m") == "12.3"
    assert format_value(Interval(0.5, 0.25, 0.75), "f_score_5cm") == "50 [25, 75]"
    assert format_value(None, "ate_m") == "-"
    assert format_value(math.inf, "time_s") == "never"
    assert format_value("a|b", "planner") == "a|b"


def test_a_table_survives_json() -> None:
    table = make_table(
        ["planner", Column("ate_table", "ate_m", "table")],
        [
            {"planner": "greedy", "ate_table": Interval(0.001, 0.0005, 0.002), "of no column": []},
            {"planner": "x"},
        ],
        "Title",
        "Note.",
    )
    assert table_from_json(table.as_json()) == table
    assert "| planner | table [mm] |" in table.as_markdown()
    assert "| greedy | 1.00 [0.500, 2.00] |" in table.as_markdown()


def test_an_interval_of_nothing_survives_json() -> None:
    empty = Interval(math.nan, math.nan, math.nan)
    table = make_table(["planner", "ate_m"], [{"planner": "greedy", "ate_m": empty}])
    again = table_from_json(json.loads(json.dumps(to_plain(table.as_json()))))
    assert "| greedy | - |" in again.as_markdown()


def test_an_unknown_key_is_refused_with_similar_ones() -> None:
    with pytest.raises(InputError, match=r"unknown metric 'ate_mm'.*similar: ate_m"):
        make_table(["ate_mm"], [])


def test_a_measure_that_came_later_has_no_column_among_older_rows() -> None:
    old, new = (
        {"spec": {"planner": name}, "error": None, "result": result}
        for name, result in (("a", {"ate_m": 0.1}), ("b", {"ate_m": 0.2, "tracked_share": None}))
    )
    grouping = Grouping(("planner",), ("ate_m", "tracked_share"))
    for rows, columns in (([old], ["planner", "ate_m"]), ([], ["planner", *grouping.keys])):
        assert [column.name for column in grouping.table(rows).columns] == columns
    assert "| a | 100 [100, 100] | - |" in grouping.table([old, new]).as_markdown()


def test_lines_are_ranked_by_the_direction_of_the_metric() -> None:
    rows = [
        {"spec": {"planner": name}, "error": None, "result": {"ate_m": ate, "f_score_5cm": f}}
        for name, ate, f in (("a", 0.2, 0.5), ("b", 0.1, 0.4), ("c", math.nan, 0.6))
    ]
    rows.append({"spec": {"planner": "d"}, "error": "ValueError", "result": None})
    for key, order in (("ate_m", "bac"), ("f_score_5cm", "cab")):
        table = Grouping(("planner",), ("ate_m", "f_score_5cm"), rank_by=key).table(rows)
        assert "".join(str(line["planner"]) for line in table.rows) == order
