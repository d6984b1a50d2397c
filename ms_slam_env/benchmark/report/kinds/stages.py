"""Time by stage: the speed of the environment and of SLAM."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure, measures, text_columns
from ms_slam_env.benchmark.report.blocks import Figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten, records
from ms_slam_env.benchmark.report.kinds.base import Kind

_STAGES = ("stages_ms", "split_ms")


class Stages(Kind):
    """Measured speed, by stage."""

    name = "speed"
    about = "Where the time of a frame, or of a step, goes."

    def fits(self, content: dict[str, Any]) -> bool:
        """Something with time by stage."""
        return any(stages_of(content))

    def figures(self, result: Result) -> list[Figure]:
        """Stacked stages; the other measures."""
        found = [stage_figure(dict(stages_of(result.content)))]
        for key in ("summary", "results"):
            rows = _rows(result.content.get(key))
            if len(rows) > 1:
                found.append(bar_figure(rows, "Measures", _names(rows), measures(rows)))
        return [figure for figure in found if figure is not None]


def stages_of(content: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, float]]]:
    """Name and milliseconds by stage, of the whole, of summary rows or of named results."""
    yield from _stages("all", content)
    for key in ("summary", "results"):
        value = content.get(key)
        if isinstance(value, list):
            rows = [row for row in value if isinstance(row, Mapping)]
            for label, row in zip(_labels(rows), rows, strict=True):
                yield from _stages(label, row)
        elif isinstance(value, Mapping):
            for name, row in value.items():
                if isinstance(row, Mapping):
                    yield from _stages(name, row)


def stage_figure(stages: dict[str, dict[str, float]]) -> Figure | None:
    """Stacked bars, one a row."""
    names = list(dict.fromkeys(stage for row in stages.values() for stage in row))
    label_of = plots.shorts(stages)
    data = [
        {
            "type": "bar",
            "orientation": "h",
            "name": plots.short(name),
            "y": [label_of[label] for label in stages],
            "x": plots.finite(row.get(name, 0.0) for row in stages.values()),
            "marker": {"color": plots.colour(index)},
            "hovertemplate": "%{y}: %{x:.3g} ms<extra>%{fullData.name}</extra>",
        }
        for index, name in enumerate(names)
    ]
    y = plots.category_axis(list(label_of.values()))
    order = {"traceorder": "normal"}
    layout = plots.layout(
        plots.axis("time [ms]"), y, barmode="stack", showlegend=True, legend=order
    )
    height = min(220 + 34 * len(stages) + 12 * len(names), 900)
    caption = "Click a stage to hide it, twice to see it alone."
    return Figure("Time by stage", caption, (plots.plot(data, layout),), height) if data else None


def _stages(label: str, row: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, float]]]:
    for key in _STAGES:
        given = row.get(key)
        values = given if isinstance(given, Mapping) else {}
        if values and all(isinstance(value, (int, float)) for value in values.values()):
            yield label, {str(name): float(value) for name, value in values.items()}


def _labels(rows: list[Mapping[str, Any]]) -> list[str]:
    """Names of rows: what differs among their texts and whole numbers."""
    flat = [_plain(row) for row in rows]
    keys = [
        key
        for key in dict.fromkeys(k for row in flat for k in row)
        if all(isinstance(row.get(key), (str, int)) for row in flat)
        and len({row.get(key) for row in flat}) > 1
        and key not in ("steps", "surfels", "lost_frames", "estimates")
    ]
    labels = [", ".join(_label(key, row[key]) for key in keys) for row in flat]
    return [label or str(index + 1) for index, label in enumerate(labels)]


def _label(key: str, value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{value} {key.replace('_', ' ')}"


def _plain(row: Mapping[str, Any]) -> Record:
    return flatten({key: value for key, value in row.items() if key not in _STAGES})


def _rows(value: Any) -> list[Record]:
    if isinstance(value, list):
        rows = [row for row in value if isinstance(row, Mapping)]
        return [
            {"row": label, **_plain(row)} for label, row in zip(_labels(rows), rows, strict=True)
        ]
    return records(value) or []


def _names(rows: list[Record]) -> list[str]:
    return ["row"] if "row" in rows[0] else text_columns(rows)
