"""Plotly traces and layouts as plain JSON; nothing here imports Plotly."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from typing import Any

from ms_slam_env.benchmark.report.blocks import Plot

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
"""Colours of a contrast of 3 and more against white and against the dark page."""
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "cross", "star", "hexagon", "bowtie")
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")

_LABEL_LENGTH = 34


def colour(index: int) -> str:
    """Colour of a series."""
    return PALETTE[index % len(PALETTE)]


def symbol(index: int) -> str:
    """Marker of a series: colour alone must not tell series apart."""
    return SYMBOLS[index % len(SYMBOLS)]


def dash(index: int) -> str:
    """Line of a series."""
    return DASHES[index % len(DASHES)]


def text(value: Any) -> str:
    """Text that Plotly shows as it is: it takes some tags for markup."""
    return html.escape(str(value), quote=False).replace("\n", "<br>")


def short(value: Any, length: int = _LABEL_LENGTH) -> str:
    """:func:`text`, with the middle left out where it is long."""
    plain = " ".join(str(value).split())
    if len(plain) > length:
        half = (length - 1) // 2
        plain = f"{plain[:half]}…{plain[-half:]}"
    return text(plain)


def shorts(values: Iterable[Any], length: int = _LABEL_LENGTH) -> dict[Any, str]:
    """A short text for each value, different ones for different values."""
    found: dict[Any, str] = {}
    for value in values:
        label = short(value, length)
        count = 1
        while label in found.values() and value not in found:
            count += 1
            label = f"{short(value, length)} ({count})"
        found.setdefault(value, label)
    return found


def axis(title: str, log: bool = False, **more: Any) -> dict[str, Any]:
    """An axis with a title; logarithmic on demand."""
    kind = {"type": "log", "dtick": "D2", "exponentformat": "none"} if log else {}
    return {"title": {"text": text(title)}, "automargin": True, **kind, **more}


def category_axis(names: Sequence[str]) -> dict[str, Any]:
    """An axis of names, the first one on top; the page shortens them on a narrow screen."""
    return {
        "automargin": True,
        "type": "category",
        "categoryorder": "array",
        "categoryarray": list(names),
        "autorange": "reversed",
    }


def layout(x: dict[str, Any], y: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A layout with the legend above the drawing."""
    return {"xaxis": x, "yaxis": y, **more}


def wide_range(values: Iterable[float | None]) -> bool:
    """Whether positive values spread over more than a factor of 30."""
    known = [value for value in values if value is not None]
    return bool(known) and min(known) > 0 and max(known) > 30 * min(known)


def finite(values: Iterable[float | None]) -> list[float | None]:
    """Values, rounded to 6 digits to keep the page small; None where they are not finite."""
    return [
        None if value is None or not math.isfinite(value) else float(f"{value:.6g}")
        for value in values
    ]


def error_bar(
    values: Sequence[float], lows: Sequence[float], highs: Sequence[float]
) -> dict[str, Any]:
    """Bars from ``lows`` to ``highs`` around ``values``."""
    return {
        "type": "data",
        "symmetric": False,
        "array": finite(high - value for high, value in zip(highs, values, strict=True)),
        "arrayminus": finite(value - low for low, value in zip(lows, values, strict=True)),
    }


def line(
    name: str, x: Sequence[float | None], y: Sequence[float | None], index: int, **more: Any
) -> dict[str, Any]:
    """A line; with ``mode`` in ``more`` also marks."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": short(name),
        "x": finite(x),
        "y": finite(y),
        "line": {"color": colour(index), "dash": dash(index // len(PALETTE)), "width": 2},
        "marker": {"color": colour(index), "symbol": symbol(index), "size": 8},
        **more,
    }


def band(
    name: str, x: Sequence[float], low: Sequence[float], high: Sequence[float], index: int
) -> dict[str, Any]:
    """The area between two lines, in the legend group of the line of the same name."""
    return {
        "type": "scatter",
        "mode": "lines",
        "x": finite([*x, *reversed(x)]),
        "y": finite([*high, *reversed(low)]),
        "fill": "toself",
        "fillcolor": f"{colour(index)}26",
        "line": {"width": 0},
        "hoverinfo": "skip",
        "showlegend": False,
        "legendgroup": short(name),
    }


def plot(data: list[dict[str, Any]], figure_layout: dict[str, Any], label: str = "") -> Plot:
    """A plot; without ``label`` the only one of its figure."""
    return Plot(label, data, figure_layout)
