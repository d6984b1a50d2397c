"""Who is to beat: the leading planner of each planner benchmark, and how far it leads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from ms_slam_env.benchmark.planner_tables import PAIRS, PRIVILEGED
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.report.results import Results
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Column, Table, make_table

_ACROSS = ": over all scenes"


def leaders(
    benchmarks: Sequence[Results], by: str, mark: Callable[[Table], Table] = lambda table: table
) -> Table:
    """Tabulate who leads each benchmark by a metric, its value, and whom it leads how often.

    Planners that see the truth are left out: ``mark`` adds the column that says so.

    Raises:
        InputError: a metric that planners are not compared by, or a benchmark without a planner
            that has it.
    """
    if by not in PAIRS:
        raise unknown("metric of planners", by, PAIRS)
    columns: list[Column | str] = [
        "task",
        Column("planner", heading="to beat"),
        by,
        Column("next", "planner", "next planner"),
        Column("improvement", heading="better than the next"),
    ]
    lines = [
        _leader(one, task, table, by, mark) for one in benchmarks for task, table in _headlines(one)
    ]
    return make_table(columns, lines)


def _headlines(one: Results) -> Iterator[tuple[str, Table]]:
    """The table over all scenes of each task; that of a single task has no title."""
    config = one.content.get("config")
    task = config.get("task", one.title) if isinstance(config, Mapping) else one.title
    for k, table in enumerate(one.tables):
        if k == 0 and not table.title:
            yield str(task), table
        elif table.title.endswith(_ACROSS):
            yield table.title.removesuffix(_ACROSS), table


def _leader(
    one: Results, task: str, table: Table, by: str, mark: Callable[[Table], Table]
) -> dict[str, Any]:
    known: list[tuple[float, Mapping[str, Any]]] = []
    for line in mark(table).rows:
        value = line.get(by)
        if isinstance(value, Interval) and line.get(PRIVILEGED) is not True:
            known.append((-value.value, line))
    if not known:
        raise InputError(f"{one.title!r}: no planner without the truth has {by} in {task}")
    (_, best), *rest = sorted(known, key=lambda pair: pair[0])  # stable: the table's order in a tie
    found = {"task": task, "planner": best["planner"], by: best[by]}
    if rest:
        follower = rest[0][1]["planner"]
        title = f"{task}: {PAIRS[by]}" if table.title else PAIRS[by]
        pairs = [other for other in one.tables if other.title == title]
        found |= {"next": follower, "improvement": _chance(pairs, best["planner"], follower)}
    return found


def _chance(pairs: Sequence[Table], best: Any, other: Any) -> Interval | None:
    """Probability that one planner is better than another, from the benchmark's own table."""
    for table in pairs:
        for line in table.rows:
            value = line.get(str(other))
            if line.get("planner") == best and isinstance(value, Interval):
                return value
    return None
