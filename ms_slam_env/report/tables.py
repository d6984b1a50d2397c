"""Tables of metrics with intervals, as Markdown and as JSON for reports."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.records import build, check_plain
from ms_slam_env.report.statistics import Interval, median_interval, share_interval

_SMALLEST = 1e-6  # smaller values would print as a row of zeros

Value = str | float | int | bool | None | Interval
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: name of its cells in the rows.
        key: key of the metric, which has heading, unit and explanation; ``name`` if empty.
        heading: heading instead of the metric's, for tables with several columns of one metric,
            such as one per scene.
    """

    name: str
    key: str = ""
    heading: str = ""

    @property
    def label(self) -> str:
        """Heading with unit."""
        of = metric(self.key or self.name)
        unit = f" [{of.shown_unit}]" if of.shown_unit else ""
        return f"{self.heading}{unit}" if self.heading else of.label


@dataclass(frozen=True)
class Table:
    """A table; the metric registry explains its columns.

    Attributes:
        columns: columns; :func:`make_table` is a shorter way to give them.
        rows: column name to value, in the metric's stored unit; None if unknown.
        title: title above the table.
        note: a sentence or two below the title.

    Raises:
        InputError: a column whose key the registry does not know.
    """

    columns: tuple[Column, ...]
    rows: tuple[Mapping[str, Value], ...]
    title: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        """Refuse unknown keys."""
        for column in self.columns:
            metric(column.key or column.name)

    def as_json(self) -> dict[str, Any]:
        """The table as plain JSON types."""
        return {
            "title": self.title,
            "note": self.note,
            "columns": [asdict(column) for column in self.columns],
            "rows": [
                {n: asdict(v) if isinstance(v, Interval) else v for n, v in row.items()}
                for row in self.rows
            ],
        }

    def as_markdown(self, level: int = 3) -> str:
        """Title, note and table as Markdown."""
        parts = []
        if self.title:
            parts.append(f"{'#' * level} {self.title}\n")
        if self.note:
            parts.append(f"{self.note}\n")
        body = [[format_value(row.get(c.name), c.key or c.name) for c in self.columns]
                for row in self.rows]  # fmt: skip
        parts.append(markdown_table([c.label for c in self.columns], body))
        return "\n".join(parts)


def make_table(
    columns: Iterable[Column | str],
    rows: Iterable[Mapping[str, Value]],
    title: str = "",
    note: str = "",
) -> Table:
    """Make a table; a column with the metric's own heading can be given by name.

    Drops cells that belong to no column.
    """
    full = tuple(Column(column) if isinstance(column, str) else column for column in columns)
    names = [column.name for column in full]
    cells = tuple({name: row[name] for name in names if name in row} for row in rows)
    return Table(full, cells, title, note)


def table_from_json(content: Mapping[str, Any]) -> Table:
    """Rebuild a table from the output of :meth:`Table.as_json`.

    Raises:
        InputError: a key that the registry does not know.
        KeyError, TypeError: malformed content.
    """
    columns = [build(Column, column) for column in content["columns"]]
    names = {column.name for column in columns}
    rows = [
        {name: _value_from_json(value) for name, value in row.items() if name in names}
        for row in content["rows"]
    ]
    return make_table(columns, rows, str(content.get("title", "")), str(content.get("note", "")))


def _value_from_json(value: Any) -> Value:
    """The original value; JSON holds null for NaN."""
    if isinstance(value, dict):
        return Interval(**{n: math.nan if v is None else float(v) for n, v in value.items()})
    check_plain("a cell", value)
    return value


@dataclass(frozen=True)
class Grouping:
    """How to group rows of an experiment into lines of a table.

    Attributes:
        by: fields of the spec that a line groups by.
        keys: metrics to summarise.
        label: text for a field's value, if it differs from the value.
        rank_by: metric that orders the lines, best first; order of appearance if empty.
        count: key of a column with the number of finished rows per line; none if empty.
    """

    by: tuple[str, ...]
    keys: tuple[str, ...]
    label: Mapping[str, Callable[[Any], str]] = field(default_factory=dict)
    rank_by: str = ""
    count: str = ""

    def table(self, rows: Sequence[Row], title: str = "", note: str = "") -> Table:
        """Medians (shares for flags) with 95 % intervals over the finished rows of each line."""
        lines: list[dict[str, Value]] = []
        for group, results in grouped(rows, self.by).items():
            values: dict[str, Value] = {
                name: self.label[name](value) if name in self.label else value
                for name, value in zip(self.by, group, strict=True)
            }
            if self.count:
                values[self.count] = len(results)
            values |= {key: summary(results, key) for key in self.keys}
            lines.append(values)
        if self.rank_by:
            lines.sort(key=lambda line: _rank(line[self.rank_by], metric(self.rank_by).better))
        counted = (self.count,) if self.count else ()
        return make_table((*self.by, *counted, *measured(self.keys, rows)), lines, title, note)


def measured(keys: Sequence[str], rows: Iterable[Row]) -> tuple[str, ...]:
    """The metrics except those added after all finished rows were measured."""
    results = [row["result"] for row in finished(rows)]
    return tuple(key for key in keys if not results or any(key in one for one in results))


def finished(rows: Iterable[Row]) -> list[Row]:
    """The rows without an error."""
    return [row for row in rows if row["error"] is None]


def grouped(rows: Iterable[Row], by: Sequence[str]) -> dict[tuple[Any, ...], list[Row]]:
    """Results of finished rows, grouped by the values of fields ``by`` of their specs."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in finished(rows):
        groups.setdefault(tuple(row["spec"][name] for name in by), []).append(row["result"])
    return groups


def complete_cases(rows: Iterable[Row], case: Sequence[str], compared: str) -> list[Row]:
    """Finished rows of the cases that all compared values have finished.

    Args:
        rows: rows of an experiment.
        case: fields of the spec that define a case, such as scene and seed.
        compared: field whose values are compared in each case.
    """
    done = finished(rows)
    found: dict[tuple[Any, ...], set[Any]] = {}
    for row in done:
        case_of = tuple(row["spec"][name] for name in case)
        found.setdefault(case_of, set()).add(row["spec"][compared])
    every = set().union(*found.values())
    return [row for row in done if found[tuple(row["spec"][name] for name in case)] == every]


def flattened(rows: Iterable[Row], key: str) -> list[dict[str, Any]]:
    """A row for each mapping in the list ``key`` of each finished row's result.

    Its texts and flags are added to the spec, so that rows can be grouped by them.
    """
    return [
        {
            "spec": {**row["spec"], **{k: v for k, v in one.items() if isinstance(v, (str, bool))}},
            "result": one,
            "error": None,
        }
        for row in finished(rows)
        for one in row["result"][key]
    ]


def summary(results: Iterable[Row], key: str) -> Interval:
    """Median (share for flags) of a metric with its 95 % interval; NaN without values."""
    values = [result[key] for result in results if result.get(key) is not None]
    values = [value for value in values if not math.isnan(value)]
    return share_interval(values) if metric(key).unit == "flag" else median_interval(values)


def _rank(value: Any, better: str) -> float:
    number = value.value if isinstance(value, Interval) else value
    if number is None or math.isnan(number):
        return math.inf
    return -number if better == "higher" else number


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with the first column left-aligned and the others right-aligned."""
    lines = [_line(header), _line(["---", *["---:"] * (len(header) - 1)])]
    return "\n".join(lines + [_line(row) for row in rows]) + "\n"


def format_value(value: Value, key: str) -> str:
    """``value`` of metric ``key`` as text in its shown unit; ``-`` if unknown."""
    of = metric(key)
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    if isinstance(value, Interval):
        digits = 3 if of.unit == "count" else of.digits  # a median lies between two counts
        return format_interval(value, of.scale, digits)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if of.scale == 1 and float(value).is_integer() and (isinstance(value, int) or of.digits > 8):
        return str(int(value))
    between = of.unit == "count" and of.digits > 8  # a mean of counts
    return format_number(value * of.scale, 3 if between else of.digits)


def format_interval(interval: Interval, scale: float = 1.0, digits: int = 2) -> str:
    """``value [low, high]``, each times ``scale``, rounded to ``digits`` significant digits."""
    if math.isnan(interval.value):
        return "-"
    parts = [
        format_number(x * scale, digits) for x in (interval.value, interval.low, interval.high)
    ]
    return f"{parts[0]} [{parts[1]}, {parts[2]}]"


def format_number(value: float, digits: int = 2) -> str:
    """``value`` with ``digits`` significant digits; below a millionth in exponent notation.

    Infinity, the time of something that never happened, becomes ``never``.
    """
    if math.isnan(value):
        return "-"
    if value == math.inf:
        return "never"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < _SMALLEST:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(" ".join(c.split()).replace("|", "\\|") for c in cells) + " |"
