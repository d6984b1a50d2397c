"""Charts as data: ``figures`` draws them as PNG, a report page as interactive plots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ms_slam_env.errors import InputError, unknown
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.records import build
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import Row, finished, grouped, summary

MODES = ("lines", "lines+markers", "markers", "dots", "dashes", "bars")

Point = float | int | str | None


@dataclass(frozen=True)
class Series:
    """A named series of points.

    Attributes:
        name: legend entry; series of the same name look alike in all panels.
        x: (n,) numbers in the metric's stored unit, or names of categories.
        y: (n,) likewise.
        low: (n,) lower ends of an interval around ``y`` (around ``x`` if ``y`` holds names).
        high: (n,) upper ends.
        mode: ``lines``, ``markers``, ``lines+markers``, ``bars``; ``dots`` are small and pale,
            ``dashes`` a dashed line without colour, for a reference such as the truth.
        text: (n,) description of each point, shown on hover.
    """

    name: str
    x: Sequence[Point]
    y: Sequence[Point]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()
    mode: str = "lines+markers"
    text: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Refuse unknown modes and columns of different lengths.

        Raises:
            InputError: one of these; the message names the series.
        """
        if self.mode not in MODES:
            raise unknown("mode of a series", self.mode, MODES)
        others = (self.y, self.low, self.high, self.text)
        if any(len(part) not in (len(self.x), 0) for part in others) or (
            (len(self.y), len(self.high)) != (len(self.x), len(self.low))
        ):
            raise InputError(f"series {self.name!r}: its columns differ in length")


@dataclass(frozen=True)
class Guide:
    """A straight dashed line, for example at a target.

    Attributes:
        value: position on its axis, in the stored unit.
        axis: axis that it crosses, ``x`` or ``y``.
        name: legend entry; none if empty.
    """

    value: float
    axis: str = "y"
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse unknown axes.

        Raises:
            InputError: unknown axis; the message lists the valid ones.
        """
        if self.axis not in ("x", "y"):
            raise unknown("axis of a guide", self.axis, ("x", "y"))


@dataclass(frozen=True)
class Panel:
    """One drawing with two axes.

    Attributes:
        x: key of the metric on the x axis; empty for categories.
        y: key of the metric on the y axis; empty for categories.
        series: series to draw.
        log: logarithmic axes: ``""``, ``x``, ``y`` or ``xy``.
        guides: straight lines to draw.
        title: title above the panel.
        equal: whether both axes have the same scale, as in a floor plan.
    """

    x: str
    y: str
    series: Sequence[Series]
    log: str = ""
    guides: Sequence[Guide] = ()
    title: str = ""
    equal: bool = False

    def __post_init__(self) -> None:
        """Refuse unknown keys and axes.

        Raises:
            InputError: a key that the registry does not know, or other axes than x and y.
        """
        for key in filter(None, (self.x, self.y)):
            metric(key)
        if self.log not in ("", "x", "y", "xy"):
            raise unknown("logarithmic axes", self.log, ("x", "y", "xy"))


@dataclass(frozen=True)
class Chart:
    """Panels side by side; a page shows one at a time.

    Attributes:
        name: name of the PNG file, without extension.
        title: title above the chart.
        caption: explanation of the marks.
        panels: from left to right, in rows of four.
    """

    name: str
    title: str
    caption: str
    panels: Sequence[Panel]

    def as_json(self) -> dict[str, Any]:
        """The chart as plain JSON types."""
        return asdict(self)


def chart_from_json(content: Mapping[str, Any]) -> Chart:
    """Rebuild a chart from the output of :meth:`Chart.as_json`.

    Raises:
        InputError: a key that the registry does not know.
        KeyError, TypeError: malformed content.
    """
    panels = [
        build(
            Panel,
            {
                **panel,
                "series": [build(Series, series) for series in panel["series"]],
                "guides": [build(Guide, guide) for guide in panel.get("guides", ())],
            },
        )
        for panel in content["panels"]
    ]
    return build(Chart, {**content, "panels": panels})


def interval_series(
    name: str, x: Sequence[Point], values: Sequence[Interval], mode: str = "lines+markers"
) -> Series:
    """A series of estimates with their intervals."""
    low, value, high = (
        [getattr(v, part) for v in values] for part in ("low", "value", "high")
    )  # fmt: skip
    return Series(name, x, value, low, high, mode)


def over_field(
    rows: Sequence[Row],
    field: str,
    keys: Iterable[str],
    by: str = "",
    x: str = "",
    log: Iterable[str] = (),
    label: Callable[[Any], str] = str,
) -> list[Panel]:
    """A panel for each metric of ``keys``: its median and interval over a field of the specs.

    Args:
        rows: rows of an experiment.
        field: field of the specs on the x axis.
        keys: metrics on the y axes.
        by: field with one line per value; a single line if empty.
        x: metric key of the field, if it differs from ``field``.
        log: keys to draw on a logarithmic axis.
        label: turns a value of ``by`` into the name of its line.
    """
    cells = grouped(rows, (by, field) if by else (field,))
    names = dict.fromkeys(group[0] if by else "" for group in cells)
    logarithmic = set(log)
    panels = []
    for key in keys:
        series = []
        for name in names:
            found = {g[-1]: r for g, r in cells.items() if not by or g[0] == name}
            values = [summary(found[value], key) for value in sorted(found)]
            series.append(interval_series(label(name), sorted(found), values))
        panels.append(Panel(x or field, key, series, "y" if key in logarithmic else ""))
    return panels


def by_group(
    rows: Sequence[Row],
    by: str,
    keys: Iterable[str],
    log: Iterable[str] = (),
    order: Sequence[Any] = (),
    label: Callable[[Any], str] = str,
) -> list[Panel]:
    """A panel for each metric: every row as a dot and each group's median with its interval.

    Args:
        rows: rows of an experiment.
        by: field of the specs that groups the rows.
        keys: metrics on the x axes.
        log: keys to draw on a logarithmic axis.
        order: groups from the top; other groups follow.
        label: turns a value of ``by`` into the name of its group.
    """
    cells = {group[0]: results for group, results in grouped(rows, (by,)).items()}
    names = [*(name for name in order if name in cells), *(n for n in cells if n not in order)]
    logarithmic = set(log)
    panels = []
    for key in keys:
        series = []
        for name in names:
            values = [r[key] for r in cells[name] if r.get(key) is not None]
            series.append(Series(label(name), values, [label(name)] * len(values), mode="dots"))
            middle = summary(cells[name], key)
            series.append(
                Series(
                    label(name), [middle.value], [label(name)], [middle.low], [middle.high],
                    "markers",
                )
            )  # fmt: skip
        panels.append(Panel(key, "", series, "x" if key in logarithmic else ""))
    return panels


def bars(
    rows: Sequence[Row], field: str, by: str, keys: Iterable[str], label: Callable[[Any], str] = str
) -> list[Panel]:
    """A panel for each metric, with bars for its median (share for flags) and its interval.

    Args:
        rows: rows of an experiment.
        field: field of the specs whose values are on the x axis.
        by: field with one colour per value.
        keys: metrics on the y axes.
        label: turns a value of ``by`` into its legend entry.
    """
    cells = grouped(rows, (by, field))
    places = list(dict.fromkeys(place for _, place in cells))
    return [
        Panel(
            "",
            key,
            [
                interval_series(
                    label(name),
                    places,
                    [summary(cells.get((name, place), []), key) for place in places],
                    "bars",
                )
                for name in dict.fromkeys(name for name, _ in cells)
            ],
        )
        for key in keys
    ]


def scatter(
    rows: Sequence[Row],
    x: str,
    y: str,
    by: str,
    log: str = "",
    floor: float = 0.0,
    label: Callable[[Any], str] = str,
) -> Panel:
    """Each row as a mark, one series per value of field ``by``; ``floor``: smallest x drawn."""
    series = []
    for name in dict.fromkeys(row["spec"][by] for row in finished(rows)):
        own = [row for row in finished(rows) if row["spec"][by] == name]
        own = [row for row in own if None not in (row["result"].get(x), row["result"].get(y))]
        series.append(
            Series(
                label(name),
                [max(row["result"][x], floor) for row in own],
                [row["result"][y] for row in own],
                mode="markers",
                text=[", ".join(f"{k} {row['spec'][k]}" for k in ("scene", "seed", "sequence")
                                if k in row["spec"]) for row in own],
            )
        )  # fmt: skip
    return Panel(x, y, series, log)


def without_long_tail(lines: Sequence[Series], times: float = 2.0) -> list[Series]:
    """Lines with the longest cut to the length of the next, if more than ``times`` as long.

    Otherwise one very long run would compress all others into a narrow strip of the chart.
    """
    ends = sorted(len(line.x) for line in lines)
    if len(ends) < 2 or ends[-1] <= times * ends[-2]:
        return list(lines)

    end = slice(ends[-2])
    return [
        replace(
            line,
            x=line.x[end],
            y=line.y[end],
            low=line.low[end],
            high=line.high[end],
            text=line.text[end],
        )
        for line in lines
    ]


def quartile_bands(
    x: str, y: str, bands: Sequence[Series], log: str = ""
) -> tuple[str, list[Panel]]:
    """Caption and panel of metric ``y`` over ``x``, from lines made by `quartile_band`."""
    cut = without_long_tail(bands)
    caption = "Line: median over episodes; band: between their quartiles."
    caption += "" if cut == list(bands) else " One goes on, cut here."
    return caption, [Panel(x, y, cut, log)]


def quartile_band(
    name: str, steps: Sequence[float], runs: Sequence[Sequence[float]], floor: float = 0.0
) -> Series:
    """Median and quartiles over runs at each step; a run that ends early keeps its last value.

    ``steps`` are those of the longest run.
    """
    length = max(map(len, runs))
    padded = np.array([[*run, *[run[-1]] * (length - len(run))] for run in runs])
    low, middle, high = np.percentile(np.maximum(padded, floor), [25, 50, 75], axis=0)
    return Series(name, list(steps[:length]), middle.tolist(), low.tolist(), high.tolist(), "lines")
