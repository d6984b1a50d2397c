"""Convert charts to Plotly's JSON, one plot per panel, without importing Plotly."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, Panel, Series

PALETTE = (
    "#3a84d6",
    "#d2691e",
    "#2c974b",
    "#cf4f94",
    "#9a5bd0",
    "#12919b",
    "#d6423d",
    "#8a8a1e",
    "#7d8590",
    "#a26b4a",
)
"""Colours with a contrast of at least 3 against white and against the dark page."""
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "cross", "star", "hexagon", "bowtie")
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
_GUIDE = "#7d8590"
_LABEL_LENGTH = 34
_DIRECTIONS = dict.fromkeys([*range(0x202A, 0x202F), *range(0x2066, 0x206A)], "\ufffd")
_OF_EVERY_OBJECT = {
    *("constructor", "hasOwnProperty", "isPrototypeOf", "propertyIsEnumerable"),
    *("toLocaleString", "toString", "valueOf", "__proto__", "__defineGetter__"),
    *("__defineSetter__", "__lookupGetter__", "__lookupSetter__"),
}
"""Property names of every JavaScript object, which Plotly would take for existing categories."""


@dataclass(frozen=True)
class Plot:
    """One panel.

    Attributes:
        label: label of this panel in a chart with several to choose from.
        data: Plotly traces.
        layout: Plotly layout; the page sets the colours of text, grid and background.
        height_px: height that the plot needs.
    """

    label: str
    data: list[dict[str, Any]]
    layout: dict[str, Any]
    height_px: int


def plots_of(chart: Chart, beside: Sequence[Chart] = ()) -> list[Plot]:
    """The panels of a chart; series of the same name look alike in all of them.

    They also look alike in the charts ``beside`` it, unless there are more names than colours.
    """
    names = _names(beside or [chart])
    names = names if len(names) <= len(PALETTE) else _names([chart])
    labels = [panel.title or _measure(panel) for panel in chart.panels]
    if len(set(labels)) < len(labels):
        labels = [f"{panel.title}: {_measure(panel)}".strip(": ") for panel in chart.panels]
    return [_plot(panel, names, label) for panel, label in zip(chart.panels, labels, strict=True)]


def _names(charts: Sequence[Chart]) -> list[str]:
    return list(dict.fromkeys(s.name for c in charts for panel in c.panels for s in panel.series))


def short(value: Any) -> str:
    """Text escaped for Plotly (which interprets some tags), with long texts cut in the middle."""
    plain = in_order(" ".join(str(value).split()))
    if len(plain) > _LABEL_LENGTH:
        half = (_LABEL_LENGTH - 1) // 2
        plain = f"{plain[:half]}…{plain[-half:]}"
    if plain in _OF_EVERY_OBJECT:
        plain = f"\u200b{plain}"  # a different name that looks the same
    return html.escape(plain, quote=False)


def in_order(text: str) -> str:
    """Text without the control characters that would reorder its letters."""
    return text.translate(_DIRECTIONS)


def _shorts(values: Iterable[str]) -> dict[str, str]:
    """A distinct short text for each value."""
    found: dict[str, str] = {}
    for value in dict.fromkeys(values):
        label, count = short(value), 1
        while label in found.values():
            count += 1
            label = f"{short(value)} ({count})"
        found[value] = label
    return found


def _measure(panel: Panel) -> str:
    """Metric of the panel: the one on its y axis, or on its x axis if y holds names."""
    key = panel.y or panel.x
    return metric(key).label if key else ""


def _plot(panel: Panel, names: Sequence[str], label: str) -> Plot:
    categories = {axis: _categories(panel, axis) for axis in "xy"}
    name_of = _shorts(names)
    data: list[dict[str, Any]] = []
    for series in panel.series:
        data += _traces(series, panel, categories, names.index(series.name), name_of[series.name])
    _show_in_legend_once(data)
    entries = sum(trace["showlegend"] for trace in data) + sum(bool(g.name) for g in panel.guides)
    in_axis = {*categories["x"], *categories["y"]}
    is_named_by_axis = bool(in_axis) and {s.name for s in panel.series} <= in_axis
    layout: dict[str, Any] = {
        "xaxis": _axis(panel.x, list(categories["x"].values())),
        "yaxis": _axis(panel.y, list(categories["y"].values())),
        "showlegend": entries > 1 and not is_named_by_axis,
        "barmode": "group",
        "shapes": _guides(panel),
    }
    for axis in (axis for axis in panel.log if not categories[axis]):
        layout[f"{axis}axis"] |= _logarithmic(panel, axis)
    if categories["y"]:
        layout["yaxis"]["autorange"] = "reversed"  # the first one on top
    if panel.equal:
        layout["yaxis"]["scaleanchor"] = "x"
    rows = len(categories["y"])
    return Plot(label, data, layout, max(300, min(110 + 30 * rows, 1400)) if rows else 420)


def _categories(panel: Panel, axis: str) -> dict[str, str]:
    """Names along an axis to their short texts; empty for an axis of numbers."""
    values = [value for series in panel.series for value in getattr(series, axis)]
    if getattr(panel, axis) and not any(isinstance(value, str) for value in values):
        return {}
    return _shorts(str(value) for value in values if value is not None)


def _axis(key: str, categories: list[str]) -> dict[str, Any]:
    axis: dict[str, Any] = {"automargin": True}
    if key:
        axis["title"] = {"text": html.escape(metric(key).label, quote=False)}
    if categories:
        return axis | {
            "type": "category",
            "categoryorder": "array",
            "categoryarray": categories,
        }
    return axis


def _logarithmic(panel: Panel, axis: str) -> dict[str, Any]:
    """A logarithmic axis with a few plain numbers: decades; 1, 2 and 5 in each; or evenly spread.

    Without a format, Plotly writes 0.05, 0.1, 0.2, 0.5 as 5, 0.1, 2, 5; ``~g`` writes a million as
    1e+6 beside 500000.
    """
    values = [value for series in panel.series for value in getattr(series, axis)]
    drawn = [value for value in values if value is not None and 0 < value < math.inf]
    decades = math.log10(max(drawn) / min(drawn)) if drawn else 0.0
    step = {} if decades < 0.8 else {"dtick": "D2" if decades < 3 else 1}
    return {"type": "log", "tickformat": ",~r", **step}


def _guides(panel: Panel) -> list[dict[str, Any]]:
    """Dashed lines across the whole drawing."""
    lines = []
    for guide in panel.guides:
        along = "x" if guide.axis == "y" else "y"
        key = panel.y if guide.axis == "y" else panel.x
        value = guide.value * (metric(key).scale if key else 1)
        if not math.isfinite(value):
            continue
        lines.append(
            {
                "type": "line",
                "line": {"dash": "dash", "color": _GUIDE, "width": 1.5},
                "name": short(guide.name),
                "showlegend": bool(guide.name),
                f"{along}ref": "paper",
                f"{along}0": 0,
                f"{along}1": 1,
                f"{guide.axis}ref": guide.axis,
                f"{guide.axis}0": value,
                f"{guide.axis}1": value,
            }
        )
    return lines


def _show_in_legend_once(traces: list[dict[str, Any]]) -> None:
    """One legend entry per name: its first trace that is not pale dots, otherwise its first."""
    for name in {trace["name"] for trace in traces}:
        own = [trace for trace in traces if trace["name"] == name]
        clear = [t for t in own if not t.get("fill") and t.get("opacity", 1) == 1]
        for trace in own:
            trace["showlegend"] = bool(name) and trace is (clear or own)[0]


def _traces(
    series: Series,
    panel: Panel,
    categories: Mapping[str, Mapping[str, str]],
    index: int,
    name: str,
) -> list[dict[str, Any]]:
    """The trace of a series, preceded by the band of its interval if it has one."""
    colour = PALETTE[index % len(PALETTE)]
    x, y = (_values(getattr(series, a), getattr(panel, a), categories[a]) for a in "xy")
    trace: dict[str, Any] = {"name": name, "legendgroup": name, "x": x, "y": y}
    if series.text:
        trace["text"] = [short(text) for text in series.text]
    if series.mode == "bars":
        flat = {"orientation": "h"} if categories["y"] else {}
        trace |= {"type": "bar", "marker": {"color": colour}, "textposition": "none", **flat}
    else:
        marker = {"color": colour, "symbol": _SYMBOLS[index % len(_SYMBOLS)], "size": 8}
        dash = _DASHES[index // len(PALETTE) % len(_DASHES)]
        line = {"color": colour, "dash": dash, "width": 2}
        trace |= {"type": "scatter", "mode": series.mode, "marker": marker, "line": line}
    if series.mode == "dots":
        trace |= {"mode": "markers", "opacity": 0.5, "marker": {**trace["marker"], "size": 5}}
    if series.mode == "dashes":
        trace |= {"mode": "lines", "line": {"color": _GUIDE, "dash": "dash", "width": 2}}
    along = "x" if categories["y"] else "y"
    if not series.low or categories[along]:
        return [trace]
    low, high = (_values(part, getattr(panel, along), {}) for part in (series.low, series.high))
    if series.mode.startswith("lines") and along == "y":
        return [_band(trace, low, high, colour), trace]
    bars = _error_bars(trace[along], low, high)
    return [{**trace, f"error_{along}": bars}]


def _values(values: Sequence[Any], key: str, categories: Mapping[str, str]) -> list[Any]:
    """Short names, or numbers in the shown unit, with None for those that are not finite."""
    if categories:
        return [None if value is None else categories[str(value)] for value in values]
    scale = metric(key).scale if key else 1
    return [None if value is None else _rounded(value * scale) for value in values]


def _rounded(value: float) -> float | None:
    """``value`` rounded to 6 digits, which keeps the page small."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _band(
    trace: Mapping[str, Any], low: Sequence[Any], high: Sequence[Any], colour: str
) -> dict[str, Any]:
    """The area between two lines."""
    points = [p for p in zip(trace["x"], low, high, strict=True) if None not in p]
    return {
        "type": "scatter",
        "mode": "lines",
        "name": trace["name"],
        "legendgroup": trace["legendgroup"],
        "x": [x for x, _, _ in points] + [x for x, _, _ in reversed(points)],
        "y": [top for _, _, top in points] + [bottom for _, bottom, _ in reversed(points)],
        "fill": "toself",
        "fillcolor": f"{colour}26",
        "line": {"width": 0},
        "hoverinfo": "skip",
    }


def _error_bars(middle: Sequence[Any], low: Sequence[Any], high: Sequence[Any]) -> dict[str, Any]:
    """Bars from ``low`` to ``high`` around ``middle``."""

    def lengths(ends: Sequence[Any], sign: int) -> list[float | None]:
        return [
            None if None in (value, end) else _rounded(max(0.0, sign * (end - value)))
            for value, end in zip(middle, ends, strict=True)
        ]

    return {
        "type": "data",
        "symmetric": False,
        "array": lengths(high, 1),
        "arrayminus": lengths(low, -1),
    }
