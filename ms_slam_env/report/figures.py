"""Draw charts as PNG files, without a display; helpers for other figures."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, Panel, Series

_PALETTE = matplotlib.color_sequences["petroff10"]
_DASHES = ("-", "--", ":", "-.")
_LOOKS: dict[str, dict[str, Any]] = {
    "lines": {},
    "dashes": {"linestyle": "--", "color": "0.1", "zorder": 3},
    "lines+markers": {"marker": "o", "markersize": 4},
    "markers": {"linestyle": "", "marker": "o"},
    "dots": {"linestyle": "", "marker": ".", "markersize": 5, "alpha": 0.35},
}
_COLUMNS = 4
_LONG_NAME = 30  # letters; a legend with longer names would leave no room for the panels


@matplotlib.rc_context({"text.parse_math": False})  # a dollar sign is not markup
def save_charts(charts: Iterable[Chart], out: Path) -> list[Path]:
    """Draw each chart into folder ``out`` under its name; return the paths."""
    return [save(draw(chart), out / f"{chart.name}.png") for chart in charts]


def draw(chart: Chart) -> Figure:
    """The chart with its panels side by side, in rows of four, and one legend."""
    names = list(dict.fromkeys(s.name for panel in chart.panels for s in panel.series))
    categories = {str(y) for p in chart.panels if not p.y for s in p.series for y in s.y}
    longest = max(map(len, categories), default=0)
    width = 5.2 if len(chart.panels) == 1 else 3.4  # a single one holds the legend, too
    columns = min(len(chart.panels), _COLUMNS)
    rows = -(-len(chart.panels) // _COLUMNS)
    figure = new_figure(
        columns,
        width + max(0.0, 0.08 * longest - 1.0) / columns,
        rows * max(3.2, 1.2 + 0.4 * len(categories)),
    )
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, panel in zip(axes, chart.panels, strict=False):
        _draw_panel(ax, panel, names)
    for ax in axes[len(chart.panels) :]:
        ax.remove()
    for k, ax in enumerate(axes):
        if categories and k % columns:
            ax.tick_params(labelleft=False)
    handles: dict[str, Any] = {}
    for ax in axes:
        handles |= {
            label: line for line, label in zip(*ax.get_legend_handles_labels(), strict=True)
        }
    named = {name: line for name, line in handles.items() if name not in categories}
    if len(named) > 1:
        is_long = max(map(len, named)) > _LONG_NAME
        place: Any = "outside lower left" if is_long else "outside right center"
        beside = max(1, columns - 1) if is_long else 1
        figure.legend(list(named.values()), list(named), loc=place, fontsize="small", ncols=beside)
        if is_long:
            height = 3.2 * rows + 0.2 * -(-len(named) // beside)
            figure.set_size_inches(max(figure.get_figwidth(), 6.0), height)
    caption(figure, chart.caption)
    return figure


def _draw_panel(ax: Axes, panel: Panel, names: Sequence[str]) -> None:
    for series in panel.series:
        _draw_series(ax, panel, series, colour(names.index(series.name)), names)
    for guide in panel.guides:
        line = ax.axhline if guide.axis == "y" else ax.axvline
        scale = _scale(panel.y if guide.axis == "y" else panel.x)
        line(guide.value * scale, linestyle="--", color="0.4", label=guide.name or None)
    ax.set_xlabel(metric(panel.x).label if panel.x else "")
    ax.set_ylabel(metric(panel.y).label if panel.y else "")
    ax.set_title(panel.title, fontsize="medium")
    ax.grid(alpha=0.3)
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")
    if not panel.y:
        ax.invert_yaxis()
    if not panel.x:
        ax.tick_params(axis="x", rotation=30)
    if "x" in panel.log:
        ax.set_xscale("log")
        plain_log_ticks(ax.xaxis)
    if "y" in panel.log:
        ax.set_yscale("log")
        plain_log_ticks(ax.yaxis)


def _draw_series(
    ax: Axes, panel: Panel, series: Series, color: str, names: Sequence[str]
) -> None:  # fmt: skip
    x, y = _scaled(series.x, panel.x), _scaled(series.y, panel.y)
    label = series.name or None
    if series.mode == "bars":
        share = 0.8 / max(1, len(names))
        places = np.arange(len(x)) + share * (names.index(series.name) - (len(names) - 1) / 2)
        ax.bar(places, y, share, color=color, label=label)
        ax.set_xticks(range(len(x)), [str(value) for value in series.x])
        x = list(places)
    else:
        look = {"color": color, **_LOOKS[series.mode]}
        if series.mode.startswith("lines"):
            again = names.index(series.name) // len(_PALETTE)  # times that all colours were used
            look["linestyle"] = _DASHES[again % len(_DASHES)]
        ax.plot(x, y, label=None if series.mode == "dots" else label, **look)
    if not series.low:
        return
    is_flat = not panel.y  # categories on the y axis, so the interval is along x
    key, middle = (panel.x, x) if is_flat else (panel.y, y)
    low, high = _scaled(series.low, key), _scaled(series.high, key)
    if series.mode.startswith("lines"):
        ax.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
        return
    spread = np.maximum([np.subtract(middle, low), np.subtract(high, middle)], 0)
    spreads = (spread, None) if is_flat else (None, spread)
    ax.errorbar(x, y, xerr=spreads[0], yerr=spreads[1], fmt="none", color=color, capsize=4)


def _scale(key: str) -> float:
    return metric(key).scale if key else 1.0


def _scaled(values: Sequence[Any], key: str) -> list[Any]:
    """Values in the shown unit, or category names as text."""
    if not key or any(isinstance(value, str) for value in values):
        return [str(value) for value in values]
    return [np.nan if value is None else value * _scale(key) for value in values]


def new_figure(columns: int = 1, width: float = 3.4, height: float = 3.2) -> Figure:
    """An empty figure for ``columns`` panels, without a display."""
    return Figure(figsize=(width * columns, height), layout="constrained")


def caption(figure: Figure, text: str) -> None:
    """Explain the marks above the panels."""
    figure.suptitle(text, x=0.01, horizontalalignment="left", fontsize="small")


def plain_log_ticks(axis: Axis) -> None:
    """Label a logarithmic axis, after drawing its data, with a few plain, non-overlapping numbers.

    Matplotlib's default labels, such as 2 x 10^0, overlap on a narrow axis.
    """
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    fine = {0.7: None, 1.7: (1, 2, 5), 2.7: (1, 3)}
    subs = next((subs for most, subs in fine.items() if decades < most), (1,))
    locator = MaxNLocator(4) if subs is None else LogLocator(subs=subs)
    axis.set_major_locator(locator)
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def save(figure: Figure, path: Path, dpi: int = 120) -> Path:
    """Write a figure as PNG, atomically."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=dpi, format="png")
    write_bytes(path, picture.getvalue())
    return path


def colour(index: int) -> str:
    """Colour of a series, distinguishable with common colour-vision deficiencies."""
    return matplotlib.colors.to_hex(_PALETTE[index % len(_PALETTE)])
