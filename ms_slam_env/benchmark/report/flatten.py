"""Rows and columns out of the JSON of a result, whatever its form."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ms_slam_env.benchmark.report.blocks import Cell, Table
from ms_slam_env.benchmark.report.glossary import heading, meaning, unit
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, format_number

Value = str | float | int | bool | Interval | None
Record = dict[str, Value]

_MAX_COLUMNS = 60
_MAX_ROWS = 2000
_MAX_INT = 2**63


def flatten(row: Mapping[str, Any], prefix: str = "") -> Record:
    """One level from nested objects, keys joined by dots.

    ``{value, low, high}`` becomes an :class:`Interval`; the parts ``spec`` and ``result`` of a run
    leave no trace in the keys; up to four numbers of a list have columns of their own, longer
    lists of numbers are left out.
    """
    found: Record = {}
    for key, value in row.items():
        name = f"{prefix}{key}"
        if is_interval(value):
            found[name] = Interval(*(float(value[part]) for part in ("value", "low", "high")))
        elif isinstance(value, Mapping):
            inner = prefix if key in ("spec", "result") else f"{name}."
            found.update(flatten(value, inner))
        elif isinstance(value, int) and abs(value) > _MAX_INT:
            found[name] = f"{str(value)[:12]}…"
        elif isinstance(value, (str, int, float, bool)) or value is None:
            found[name] = value
        elif isinstance(value, list) and 0 < len(value) <= 4 and all(map(_is_measure, value)):
            for place, part in enumerate(value, start=1):
                found.update(flatten({f"{name}.{place}": part}))
        elif isinstance(value, list) and len(value) <= 8 and not any(map(_nested, value)):
            found[name] = ", ".join(cell_of(part).text for part in value)
    return found if prefix else _with_ends(found)


def _with_ends(row: Record) -> Record:
    """``row`` with one interval in place of ``x``, ``x_low`` and ``x_high``."""
    found = dict(row)
    for key, value in row.items():
        ends = [row.get(f"{key}_{end}") for end in ("low", "high")]
        if all(isinstance(v, (int, float)) for v in (value, *ends)):
            low, high = (found.pop(f"{key}_{end}") for end in ("low", "high"))
            found[key] = Interval(*(float(v) for v in (value, low, high)))  # type: ignore[arg-type]
    return found


def is_interval(value: Any) -> bool:
    """Whether JSON ``value`` is an estimate with its interval, all three known."""
    return (
        isinstance(value, Mapping)
        and set(value) == {"value", "low", "high"}
        and all(isinstance(part, (int, float)) for part in value.values())
        and all(abs(part) <= _MAX_INT for part in value.values())
    )


def records(value: Any, names: Sequence[str] = ()) -> list[Record] | None:
    """Rows of a list of objects, or of objects of objects of the same form; else None.

    Args:
        value: JSON.
        names: for the columns that hold the keys of the outer objects; ``item`` without one.
    """
    if isinstance(value, list) and value and all(isinstance(row, Mapping) for row in value):
        return [flatten(row) for row in value]
    if not _has_rows(value):
        return None
    name, *rest = [*names, "item"] if names else ["item"]
    found = []
    for key, inner in value.items():
        deeper = records(inner, rest) if _has_rows(inner) else None
        for row in deeper if deeper is not None else [flatten(inner)]:
            found.append({_free(name, row): _placeor_text(key), **row})
    return found


def table_of(rows: Sequence[Record], title: str, folded: bool = False) -> Table:
    """A table; columns that are the same in all of many rows are named in its note instead."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    fixed = {
        key: rows[0].get(key)
        for key in columns
        if len(rows) > 3 and len({str(row.get(key)) for row in rows}) == 1
    }
    shown = [key for key in columns if key not in fixed and key != "key"][:_MAX_COLUMNS]
    body = tuple(tuple(cell_of(row.get(key), key) for key in shown) for row in rows[:_MAX_ROWS])
    headings = tuple(heading(key) for key in shown)
    note = ", ".join(
        f"{heading(key)} {cell_of(value, key).text}"
        for key, value in fixed.items()
        if value not in (None, "") and key != "key"
    )
    if len(rows) > _MAX_ROWS:
        title = f"{title} (the first {_MAX_ROWS} of {len(rows)} rows)"
    return Table(
        title,
        headings,
        body,
        {h: text for key, h in zip(shown, headings, strict=True) if (text := meaning(key))},
        f"The same in every row: {note}." if note else "",
        folded,
    )


def cell_of(value: Value, key: str = "") -> Cell:
    """A value as a cell, in the unit of its key."""
    _, scale = unit(key)
    if value is None:
        return Cell("–")
    if isinstance(value, bool):
        return Cell("yes" if value else "no", float(value))
    if isinstance(value, int) and scale == 1.0:
        return Cell(str(value), float(value) if abs(value) < 2**53 else None)
    if isinstance(value, (int, float)):
        return Cell(format_number(value * scale, 4), value * scale)
    if isinstance(value, Interval):
        return Cell(format_interval(value, scale, 3), value.value * scale)
    return Cell(str(value))


def number(value: Value) -> float | None:
    """The number in a value, None where there is none that is finite."""
    if isinstance(value, Interval):
        value = value.value
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def _has_rows(value: Any) -> bool:
    """Whether ``value`` is an object of objects that have half of their keys in common."""
    if not isinstance(value, Mapping) or len(value) < 1 or is_interval(value):
        return False
    inner = list(value.values())
    if not all(isinstance(row, Mapping) and row and not is_interval(row) for row in inner):
        return False
    common = set.intersection(*(set(row) for row in inner))
    return 2 * len(common) >= max(len(row) for row in inner)


def _is_measure(value: Any) -> bool:
    """Whether JSON ``value`` is a number or an estimate."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= _MAX_INT
    return is_interval(value) or isinstance(value, float)


def _nested(value: Any) -> bool:
    return isinstance(value, (list, Mapping))


def _free(name: str, row: Record) -> str:
    while name in row:
        name += " "
    return name


def _placeor_text(key: str) -> Value:
    try:
        return float(key) if "." in key else int(key)
    except ValueError:
        return key
