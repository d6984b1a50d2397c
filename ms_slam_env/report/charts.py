"""Charts as data: drawn as PNG by ``figures`` and, interactive, by the page of a report."""

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
    """Points of one name.

    Attributes:
        name: in the legend; series of one name in several panels look alike.
        x: (n,) numbers in the metric's stored unit, or names of categories.
        y: (n,) the same.
        low: (n,) lower ends of an interval around ``y`` (around ``x`` where ``y`` are names).
        high: (n,) upper ends.
        mode: ``lines``, ``markers``, ``lines+markers``, ``bars``; ``dots`` are small and pale,
            ``dashes`` a broken line of no colour, such as a truth.
        text: (n,) what each point is, shown on pointing at it.
    """

    name: str
    x: Sequence[Point]
    y: Sequence[Point]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()
    mode: str = "lines+markers"
    text: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Refuse unknown modes and columns of different length.

        Raises:
            InputError: naming the series.
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
    """A straight dashed line, a target for example.

    Attributes:
        value: where it crosses its axis, stored unit.
        axis: that it crosses, ``x`` or ``y``.
        name: in the legend; empty: none.
    """

    value: float
    axis: str = "y"
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse unknown axes.

        Raises:
            InputError: listing the axes.
        """
        if self.axis not in ("x", "y"):
            raise unknown("axis of a guide", self.axis, ("x", "y"))


@dataclass(frozen=True)
class Panel:
    """One drawing with two axes.

    Attributes:
        x: key of the metric on the x axis; empty: categories.
        y: key of the metric on the y axis; empty: categories.
        series: what is drawn.
        log: axes that are logarithmic: ``""``, ``x``, ``y`` or ``xy``.
        guides: straight lines.
        title: above it.
        equal: whether both axes have one scale, for plans.
    """

    x: str
    y: str
    series: Sequence[Series]
    log: str = ""
    guides: Sequence[Guide] = ()
    title: str = ""
    equal: bool = False

    def __post_init__(self) -> None:
        """Refuse unknown keys.

        Raises:
            InputError: a key that the registry does not know.
        """
        for key in filter(None, (self.x, self.y)):
            metric(key)


@dataclass(frozen=True)
class Chart:
    """Panels side by side; a page shows one at a time.

    Attributes:
        name: of the PNG file, without its ending.
        title: above it.
        caption: what the marks are.
        panels: from left to right, in rows of four.
    """

    name: str
    title: str
    caption: str
    panels: Sequence[Panel]

    def as_json(self) -> dict[str, Any]:
        """The chart as JSON's types."""
        return asdict(self)


def chart_from_json(content: Mapping[str, Any]) -> Chart:
    """The chart that :meth:`Chart.as_json` wrote.

    Raises:
        InputError: a key that the registry does not know.
        KeyError, TypeError: content of another form.
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
        rows: of an experiment.
        field: of the specifications, on the x axis.
        keys: metrics on the y axes.
        by: field whose values have a line each; empty: one line.
        x: key of the metric that the field is; empty: ``field`` itself.
        log: keys that are drawn on a logarithmic axis.
        label: name of a line from the value of ``by``.
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
        rows: of an experiment.
        by: field of the specifications that groups them.
        keys: metrics on the x axes.
        log: keys that are drawn on a logarithmic axis.
        order: of the groups, from the top; those not named follow.
        label: name of a group from the value of ``by``.
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
    """A panel for each metric: its median, of flags the share, with its interval as a bar.

    Args:
        rows: of an experiment.
        field: of the specifications, whose values stand along the x axis.
        by: field whose values have a colour each.
        keys: metrics on the y axes.
        label: name of a colour from the value of ``by``.
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
    """Each row as a mark, one series a value of field ``by``; ``floor``: smallest x drawn."""
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
    """Lines, the longest cut to the end of the next where it is more than so many times as long.

    One run that goes on long after all others would leave these a strip of the chart.
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
    """Caption and panel of metric ``y`` over ``x``, of lines as `quartile_band` makes them."""
    cut = without_long_tail(bands)
    caption = "Line: median over episodes; band: between their quartiles."
    caption += "" if cut == list(bands) else " One goes on, cut here."
    return caption, [Panel(x, y, cut, log)]


def quartile_band(
    name: str, steps: Sequence[float], runs: Sequence[Sequence[float]], floor: float = 0.0
) -> Series:
    """Median over runs at each step and its quartiles; one that ends early keeps its last value.

    ``steps`` are those of the values of the longest run.
    """
    length = max(map(len, runs))
    padded = np.array([[*run, *[run[-1]] * (length - len(run))] for run in runs])
    low, middle, high = np.percentile(np.maximum(padded, floor), [25, 50, 75], axis=0)
    return Series(name, list(steps[:length]), middle.tolist(), low.tolist(), high.tolist(), "lines")
