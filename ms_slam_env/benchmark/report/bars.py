"""A figure for rows of any form: one measure at a time, rows along one axis, series by colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.blocks import Figure, Plot
from ms_slam_env.benchmark.report.flatten import Record, Value, number
from ms_slam_env.benchmark.report.glossary import heading, unit
from ms_slam_env.report.statistics import Interval

_MAX_SERIES = 10
_MAX_LABELS = 60
_MAX_MEASURES = 24
_NO_MEASURES = ("seed", "repeat", "elapsed_s")
_FIRST = (
    "ate_m",
    "f_score_5cm",
    "success",
    "found",
    "divergence",
    "step_ms",
    "median_ms",
    "steps_per_s",
)


def text_columns(rows: Sequence[Record]) -> list[str]:
    """Columns of text that differ between rows."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return [
        key
        for key in columns
        if key not in ("key", "error", "commit")
        and any(isinstance(row.get(key), str) for row in rows)
        and len({str(row.get(key)) for row in rows}) > 1
    ]


def measures(rows: Sequence[Record]) -> list[str]:
    """Columns of numbers that differ between rows."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    found = []
    for key in columns:
        values = [number(row.get(key)) for row in rows]
        known = {value for value in values if value is not None}
        if len(known) > 1 and key.rpartition(".")[2] not in _NO_MEASURES:
            found.append(key)
    order = {key: place for place, key in enumerate(_FIRST)}
    found.sort(key=lambda key: order.get(key, len(order)))
    return found[:_MAX_MEASURES]


def bar_figure(
    rows: Sequence[Record],
    title: str = "Measures",
    names: Sequence[str] | None = None,
    keys: Sequence[str] | None = None,
    coloured: bool = False,
    log: bool = True,
) -> Figure | None:
    """Bars (dots on a logarithmic axis where values spread far), intervals where there are any.

    Args:
        rows: one bar each.
        title: of the figure.
        names: columns that name the rows, the last of them being the series where there are
            several; by default those of text that differ.
        keys: measures to choose from; by default all that differ.
        log: whether an axis may be logarithmic.
        coloured: give each row the colour that the series of its place has in other figures.

    Returns:
        the figure; None where nothing can be compared.
    """
    names = list(text_columns(rows) if names is None else names)
    keys = list(measures(rows) if keys is None else keys)
    if not keys or len(rows) < 2:
        return None
    series_key = _series(rows, names)
    label_keys = [name for name in names if name != series_key]
    labels = [" · ".join(str(row.get(key)) for key in label_keys) for row in rows]
    if not any(labels):
        labels = [str(index + 1) for index in range(len(rows))] if series_key is None else labels
    series = ["" if series_key is None else str(row.get(series_key)) for row in rows]
    pairs = list(zip(labels, series, strict=True))
    if len(set(pairs)) < len(pairs) or len(set(labels)) > _MAX_LABELS:
        return None
    found = [_plot(rows, pairs, key, log) for key in keys if _tells_apart(rows, pairs, key)]
    if not found:
        return None
    if coloured:
        for plot in found:
            shown = [plots.colour(k) for k in range(len(rows))]
            plot.data[0]["marker"] = {**plot.data[0]["marker"], "color": shown}
    height = 110 + (14 if len(set(series)) > 1 else 20) * len(rows) + 8 * len(set(labels))
    caption = "One row each" if series_key is None else f"Colour: {heading(series_key)}"
    if any(isinstance(row.get(key), Interval) for row in rows for key in keys):
        caption += "; thin line: 95 % interval"
    return Figure(title, f"{caption}.", tuple(found), max(300, min(height, 1400)))


def _series(rows: Sequence[Record], names: Sequence[str]) -> str | None:
    """The last of several names whose values are few enough for colours."""
    if len(names) < 2:
        return None
    few = [n for n in names if len({str(row.get(n)) for row in rows}) <= _MAX_SERIES]
    return few[-1] if few else None


def _tells_apart(rows: Sequence[Record], pairs: list[tuple[str, str]], key: str) -> bool:
    """Whether measure ``key`` differs between the series of a label, where there are several."""
    if len({series for _, series in pairs}) < 2:
        return True
    values: dict[str, set[float | None]] = {}
    for row, (label, _) in zip(rows, pairs, strict=True):
        values.setdefault(label, set()).add(number(row.get(key)))
    return any(len(found) > 1 for found in values.values())


def _plot(rows: Sequence[Record], pairs: list[tuple[str, str]], key: str, may_log: bool) -> Plot:
    _, scale = unit(key)
    label_of = plots.shorts(dict.fromkeys(label for label, _ in pairs))
    values = [number(row.get(key)) for row in rows]
    log = may_log and plots.wide_range(values)
    data: list[dict[str, Any]] = []
    for index, name in enumerate(dict.fromkeys(series for _, series in pairs)):
        own = [i for i, (_, series) in enumerate(pairs) if series == name]
        own = [i for i in own if values[i] is not None]
        data.append(_trace(rows, pairs, key, own, scale, log, index, name, label_of))
    order = [label_of[label] for label in dict.fromkeys(label for label, _ in pairs)]
    y = plots.category_axis(order)
    shape: dict[str, Any] = {"scattermode": "group"} if log else {"barmode": "group"}
    if len(data) == 1:
        shape["showlegend"] = False
    x = plots.axis(heading(key), log)
    return Plot(heading(key), data, plots.layout(x, y, **shape))


def _trace(
    rows: Sequence[Record],
    pairs: list[tuple[str, str]],
    key: str,
    own: list[int],
    scale: float,
    log: bool,
    index: int,
    name: str,
    label_of: dict[Any, str],
) -> dict[str, Any]:
    found = [rows[i][key] for i in own]
    numbers = [scale * (number(value) or 0.0) for value in found]
    trace: dict[str, Any] = {
        "name": plots.short(name),
        "orientation": "h",
        "x": plots.finite(numbers),
        "y": [label_of[pairs[i][0]] for i in own],
        "marker": {"color": plots.colour(index)},
        "hovertemplate": "%{y}: %{x:.4g}<extra>%{fullData.name}</extra>",
    }
    if any(isinstance(value, Interval) for value in found):
        spans = [
            v if isinstance(v, Interval) else Interval(n, n, n)
            for v, n in zip(found, numbers, strict=True)
        ]
        trace["error_x"] = plots.error_bar(
            numbers, [scale * span.low for span in spans], [scale * span.high for span in spans]
        )
    if log:
        marker = {"color": plots.colour(index), "symbol": plots.symbol(index), "size": 9}
        return {
            **trace,
            "type": "scatter",
            "mode": "markers",
            "marker": marker,
            "offsetgroup": str(index),
        }
    return {**trace, "type": "bar"}


def spans(values: Sequence[Value], scale: float = 1.0) -> tuple[list[float], list[float]]:
    """Lower and upper ends of the intervals in ``values``; of plain numbers the numbers."""
    lows, highs = [], []
    for value in values:
        middle = number(value) or 0.0
        given = value if isinstance(value, Interval) else Interval(middle, middle, middle)
        lows.append(scale * given.low)
        highs.append(scale * given.high)
    return lows, highs
