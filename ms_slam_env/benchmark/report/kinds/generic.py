"""Results of a kind that has no figures of its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure, Table
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, cell_of, flatten, records, table_of
from ms_slam_env.benchmark.report.glossary import heading, meaning
from ms_slam_env.benchmark.report.kinds.base import Kind

SETTINGS = ("config", "options", "settings", "rule", "params", "divergence")
_DEPTH = 2


class Generic(Kind):
    """Anything: the measures of its rows, one at a time."""

    name = "benchmark"
    about = "All values of the result file, as figures and tables."

    def fits(self, content: dict[str, Any]) -> bool:
        """Every content fits."""
        return True

    def figures(self, result: Result) -> list[Figure]:
        """One figure for each group of rows that can be compared, few at most."""
        found = []
        for title, rows in row_groups(result.content):
            figure = None if is_raw(rows) else bar_figure(rows, title)
            if figure is not None:
                found.append(figure)
        if not found:
            candidates = (bar_figure(rows, t) for t, rows in row_groups(result.content))
            found = [figure for figure in candidates if figure is not None]
        return found[:3]


def row_groups(content: Mapping[str, Any]) -> list[tuple[str, list[Record]]]:
    """Groups of rows in ``content`` with a title each, results before single runs."""
    found = list(_groups(content, list(key_names(content)), _DEPTH))
    return sorted(found, key=lambda group: is_raw(group[1]))


def _groups(
    content: Mapping[str, Any], names: list[tuple[set[str], str]], depth: int
) -> Iterator[tuple[str, list[Record]]]:
    for key, value in content.items():
        if key in SETTINGS:
            continue
        rows = records(value, outer_names(value, names))
        if rows:
            yield heading(key), rows
        elif isinstance(value, Mapping) and depth:
            inner = {k: v for k, v in value.items() if isinstance(v, Mapping)}
            rows = records(inner, outer_names(inner, names)) if len(inner) > 1 else None
            if rows:
                yield heading(key), rows
            else:
                for title, deeper in _groups(value, names, depth - 1):
                    yield f"{heading(key)}: {title}", deeper


def is_raw(rows: list[Record]) -> bool:
    """Whether rows are single runs rather than a summary."""
    return any("key" in row and "elapsed_s" in row for row in rows[:1]) or len(rows) > 200


def facts(content: Mapping[str, Any], folded: bool) -> Table | None:
    """Values of ``content`` that are in no group of rows, as a table of two columns."""
    single: Record = {}
    for key, value in content.items():
        if key not in SETTINGS and not any(_groups({key: value}, [], _DEPTH)):
            single.update(flatten({key: value}))
    return _two_columns("Values", single, folded)


def settings(content: Mapping[str, Any]) -> Table | None:
    """Configuration in ``content``, folded."""
    given: Record = {}
    for key in SETTINGS:
        if isinstance(content.get(key), Mapping):
            given.update(flatten(content[key]))
    return _two_columns("Settings", given, True)


def row_tables(content: Mapping[str, Any], folded: bool) -> list[Table]:
    """Every group of rows as a table; single runs always folded."""
    return [
        table_of(rows, title, folded or is_raw(rows) or len(rows) > 40)
        for title, rows in row_groups(content)
    ]


def outer_names(value: Any, names: list[tuple[set[str], str]]) -> list[str]:
    """Names for the keys of nested objects: of the list in the settings that holds them all."""
    found = []
    while isinstance(value, Mapping) and value:
        keys = set(value)
        found.append(next((n for known, n in names if keys - {"all"} <= known), "item"))
        value = next(iter(value.values()))
    return found


def key_names(content: Mapping[str, Any]) -> Iterable[tuple[set[str], str]]:
    """Sets of texts that the settings or the runs name, each with the name of one of them."""
    for part in SETTINGS:
        given = content.get(part)
        for key, value in given.items() if isinstance(given, Mapping) else ():
            if isinstance(value, list) and all(isinstance(v, str) for v in value) and value:
                yield set(value), key.removesuffix("s")
    for value in content.values():
        rows = records(value) if isinstance(value, list) else None
        for key in dict.fromkeys(k for row in rows or () for k in row):
            texts = {row.get(key) for row in rows or ()}
            if all(isinstance(v, str) for v in texts):
                yield {str(v) for v in texts}, key


def _two_columns(title: str, values: Record, folded: bool) -> Table | None:
    if not values:
        return None
    rows = tuple((cell_of(heading(key)), cell_of(value, key)) for key, value in values.items())
    meanings = {heading(key): text for key in values if (text := meaning(key))}
    return Table(title, ("name", "value"), rows, {} if folded else meanings, "", folded)
