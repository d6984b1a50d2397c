"""A figure of lines: measures over a number, one line a series."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import spans
from ms_slam_env.benchmark.report.blocks import Figure, Plot
from ms_slam_env.benchmark.report.flatten import Record, number
from ms_slam_env.benchmark.report.glossary import heading, unit
from ms_slam_env.report.statistics import Interval


def curve_figure(
    rows: Sequence[Record],
    x: str,
    series: str | None,
    keys: Sequence[str],
    title: str,
    caption: str = "",
) -> Figure | None:
    """Lines with marks, 95 % intervals as bars where there are any.

    Args:
        rows: one mark each.
        x: column along the axis.
        series: column of which each value has a line of its own; None: one line.
        keys: measures to choose from; those that no row has are left out.
        title: of the figure.
        caption: below it.

    Returns:
        the figure; None without a measure.
    """
    known = [key for key in keys if any(number(row.get(key)) is not None for row in rows)]
    if not known:
        return None
    found = tuple(_plot(rows, x, series, key) for key in known)
    if any(isinstance(row.get(key), Interval) for row in rows for key in known):
        caption = f"{caption} Bars: 95 % intervals.".strip()
    return Figure(title, caption, found)


def _plot(rows: Sequence[Record], x: str, series: str | None, key: str) -> Plot:
    _, scale = unit(key)
    _, x_scale = unit(x)
    usable = [r for r in rows if number(r.get(key)) is not None and number(r.get(x)) is not None]
    names = list(dict.fromkeys(str(row.get(series)) if series else "" for row in usable))
    data: list[dict[str, Any]] = []
    for index, name in enumerate(names):
        own = [row for row in usable if series is None or str(row.get(series)) == name]
        own.sort(key=lambda row: number(row[x]) or 0.0)
        values = [scale * (number(row[key]) or 0.0) for row in own]
        trace = plots.line(name, [x_scale * (number(row[x]) or 0.0) for row in own], values, index)
        trace["mode"] = "lines+markers"
        if any(isinstance(row[key], Interval) for row in own):
            bars = plots.error_bar(values, *spans([row[key] for row in own], scale))
            trace["error_y"] = {**bars, "color": plots.colour(index)}
        data.append(trace)
    log = plots.wide_range(number(row[key]) for row in usable)
    more: dict[str, Any] = {} if series and len(names) > 1 else {"showlegend": False}
    y = plots.axis(heading(key), log, **({} if log else {"rangemode": "tozero"}))
    return Plot(heading(key), data, plots.layout(plots.axis(heading(x)), y, **more))
