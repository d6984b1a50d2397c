"""Markdown tables of numbers with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ms_slam_env.report.statistics import Interval


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, first column left-aligned, the others right."""
    lines = [_line(header), _line(["---", *["---:"] * (len(header) - 1)])]
    return "\n".join(lines + [_line(row) for row in rows]) + "\n"


def format_interval(interval: Interval, scale: float = 1.0, digits: int = 2) -> str:
    """``value [low, high]``, each times ``scale``, rounded to ``digits`` significant digits."""
    if math.isnan(interval.value):
        return "-"
    parts = [
        format_number(x * scale, digits) for x in (interval.value, interval.low, interval.high)
    ]
    return f"{parts[0]} [{parts[1]}, {parts[2]}]"


def format_number(value: float, digits: int = 2) -> str:
    """``value`` with ``digits`` significant digits, never in exponent notation."""
    if math.isnan(value):
        return "-"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
