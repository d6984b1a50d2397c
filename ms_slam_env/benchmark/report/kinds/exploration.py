"""Design-space exploration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Block, Code, Figure, Plot
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import cell_of, flatten
from ms_slam_env.benchmark.report.glossary import Meanings, heading, unit
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.exploration.objectives import FAILURE

Trial = Mapping[str, Any]

_CHOSEN = ("triangle-right-open", "triangle-down-open", "square-open", "star-open")


class Exploration(Kind):
    """``ms-slam explore``: SLAM configurations, tried out."""

    name = "design-space exploration"
    about = (
        "Configurations of SLAM are tried out, each trial a run over the same sequences. The "
        "Pareto front holds those that no other one beats in every objective: left of it nothing "
        "is faster at the same error, below it nothing is more accurate in the same time. Chosen "
        "from the front: fastest, the least cost whose error is not above the default's; most "
        "accurate, the least error whose cost is not above the default's; knee, farthest below "
        "the line between the ends of the front, on logarithmic axes."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Trials with parameters, and objectives."""
        trials, objectives = content.get("trials"), content.get("objectives")
        return (
            isinstance(objectives, list)
            and len(objectives) >= 2
            and isinstance(trials, list)
            and bool(trials)
            and all(isinstance(row, dict) and "params" in row for row in trials)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Pareto front, hypervolume, importance, parameters, held-out sequences."""
        content = result.content
        trials, objectives = content["trials"], content["objectives"]
        chosen = content.get("chosen") or {}
        importance = [
            {"parameter": name, "objective": heading(objective), "importance": share}
            for objective, shares in (content.get("importance") or {}).items()
            for name, share in sorted(shares.items(), key=lambda item: -item[1])
        ]
        held_out = [flatten(row) for row in content.get("held_out") or ()]
        found = [
            pareto_figure(trials, objectives, chosen),
            hypervolume_figure(content.get("hypervolume") or []),
            bar_figure(
                importance, "Importance of the parameters", ["parameter", "objective"], log=False
            ),
            parameter_figure(trials, objectives),
            bar_figure(held_out, "Held-out sequences", ["configuration"]),
        ]
        return [figure for figure in found if figure is not None]

    def tables(self, result: Result) -> list[Block]:
        """The chosen configurations, as files."""
        found: list[Block] = []
        for row in (result.content.get("chosen") or {}).values():
            path = result.folder / str(row.get("file"))
            if path.parent == result.folder and path.is_file():
                found.append(Code(path.name, path.read_text(encoding="utf-8")))
        return found

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """Time, memory and divergence as an exploration measures them."""
        return evaluation_meanings(content)


def evaluation_meanings(content: Mapping[str, Any]) -> Meanings:
    """What the figures of a configuration mean, by the clock of the result's settings."""
    config = content.get("config")
    clock = config.get("clock") if isinstance(config, Mapping) else None
    time = "time by the clock" if clock == "wall" else "processor time"
    of_sequence = (
        f"Time of a frame of the sequence: the median {time} of a processed frame, times the "
        "share of the frames that are processed."
    )
    differ = "divergence between consecutive processed frames of the sequences, nats."
    return (
        (r"(.*: )?(ext \[ms/frame of the sequence\]|load( ms| \[ms\]))", of_sequence),
        (r"(.*: )?ext( ms| \[ms(/frame)?\])", f"Median {time} of a processed frame."),
        (r"(ate m|ext ms|load ms) ratio", "Ratio to that of the default configuration."),
        (r"(.*: )?mem( mb| \[mb\])", "Memory that SLAM itself took, at its peak."),
        (r"m i", f"Largest intensity {differ}"),
        (r"m d", f"Largest depth {differ}"),
    )


def pareto_figure(
    trials: Sequence[Trial], objectives: Sequence[str], chosen: Mapping[str, Trial]
) -> Figure | None:
    """Every trial by two objectives; several pairs to choose from where there are more."""
    found = [_pareto(trials, pair[1], pair[0], chosen) for pair in combinations(objectives, 2)]
    if not any(trace["x"] for plot in found for trace in plot.data):
        return None
    caption = "One mark a trial; its parameters show under the pointer."
    return Figure("Pareto front", caption, tuple(found), 520, "Objectives")


def hypervolume_figure(values: Sequence[float]) -> Figure | None:
    """Hypervolume after each trial."""
    if len(values) < 2:
        return None
    line = plots.line("hypervolume", [float(k + 1) for k in range(len(values))], list(values), 0)
    line["line"]["shape"] = "hv"
    axes = plots.axis("finished trials"), plots.axis("hypervolume", rangemode="tozero")
    caption = "Share of the box up to the reference that the front so far dominates."
    plot = plots.plot([line], plots.layout(*axes, showlegend=False))
    return Figure("Hypervolume over trials", caption, (plot,), 340)


def parameter_figure(trials: Sequence[Trial], objectives: Sequence[str]) -> Figure | None:
    """First objective over each parameter that was varied, the second one as colour."""
    error, cost = objectives[:2]
    rows = [row for row in trials if _has(row, error, cost)]
    found = []
    for name in dict.fromkeys(key for row in rows for key in row["params"]):
        values = [row["params"].get(name) for row in rows]
        if len({str(value) for value in values}) > 1:
            found.append(_parameter(rows, name, values, error, cost))
    if not found:
        return None
    caption = f"One mark a trial; colour: {heading(cost)}."
    return Figure("Error over each parameter", caption, tuple(found), 420, "Parameter")


def _pareto(trials: Sequence[Trial], cost: str, error: str, chosen: Mapping[str, Trial]) -> Plot:
    rows = [row for row in trials if _has(row, cost, error)]
    front = sorted((row for row in rows if row.get("on_front")), key=lambda row: row[cost])
    failed = [row for row in rows if row.get(FAILURE)]
    refused = [row for row in rows if not row.get("feasible", True) and not row.get(FAILURE)]
    special = {id(row) for row in (*front, *failed, *refused)}
    plain = [row for row in rows if id(row) not in special and not row.get("default")]
    data = [
        _marks("trial", plain, cost, error, 0, "circle", 7),
        _marks("breaks a constraint", refused, cost, error, 8, "circle-open", 8),
        _marks("failed", failed, cost, error, 6, "x", 8),
        _marks("Pareto front", front, cost, error, 2, "circle", 10, mode="lines+markers"),
    ]
    for index, (name, row) in enumerate(chosen.items()):
        if _has(row, cost, error):
            label = name.replace("_", " ")
            shape = _CHOSEN[index % len(_CHOSEN)]
            data.append(_marks(label, [row], cost, error, 2, shape, 18))
    default = [row for row in rows if row.get("default")]
    data.append(_marks("default", default, cost, error, 1, "diamond", 14))
    x, y = ([unit(key)[1] * row[key] for row in rows] for key in (cost, error))
    layout = plots.layout(
        plots.axis(heading(cost), plots.wide_range(x)),
        plots.axis(heading(error), plots.wide_range(y)),
        showlegend=True,
    )
    shown = [trace for trace in data if trace["x"]]
    return Plot(f"{heading(error)} against {heading(cost)}", shown, layout)


def _marks(
    name: str,
    rows: Sequence[Trial],
    cost: str,
    error: str,
    index: int,
    shape: str,
    size: int,
    mode: str = "markers",
) -> dict[str, Any]:
    x, y = ([unit(key)[1] * row[key] for row in rows] for key in (cost, error))
    colour = plots.colour(index)
    outline = {"width": 2 if shape.endswith("open") else 0, "color": colour}
    return {
        **plots.line(name, x, y, index),
        "mode": mode,
        "text": [_description(row) for row in rows],
        "marker": {"color": colour, "symbol": shape, "size": size, "line": outline},
        "hovertemplate": f"{plots.text(heading(cost))}: %{{x:.4g}}<br>"
        f"{plots.text(heading(error))}: %{{y:.4g}}<br>%{{text}}<extra>%{{fullData.name}}</extra>",
    }


def _parameter(
    rows: Sequence[Trial], name: str, values: Sequence[Any], error: str, cost: str
) -> Plot:
    _, scale = unit(error)
    _, cost_scale = unit(cost)
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    x: list[Any] = plots.finite(values) if numbers else [plots.short(value) for value in values]
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": x,
        "y": plots.finite(scale * row[error] for row in rows),
        "text": [_description(row) for row in rows],
        "marker": {
            "color": plots.finite(cost_scale * row[cost] for row in rows),
            "colorscale": "Viridis",
            "showscale": True,
            "size": 9,
            "line": {"width": 0.5, "color": plots.PALETTE[8]},
            "colorbar": {"title": {"text": plots.text(heading(cost))}, "thickness": 12},
        },
        "hovertemplate": f"{plots.text(name)}: %{{x}}<br>{plots.text(heading(error))}: %{{y:.4g}}"
        "<br>%{text}<extra></extra>",
    }
    errors = [scale * row[error] for row in rows]
    axes = (
        plots.axis(name, numbers and plots.wide_range(values)),
        plots.axis(heading(error), plots.wide_range(errors)),
    )
    return Plot(name, [trace], plots.layout(*axes, showlegend=False))


def _description(row: Trial) -> str:
    """Number and parameters of a trial, some to a line."""
    words = [f"{name} {cell_of(value).text}" for name, value in flatten(row["params"]).items()]
    lines = [", ".join(words[k : k + 3]) for k in range(0, len(words), 3)]
    return "<br>".join(plots.text(line) for line in (f"trial {row.get('trial')}", *lines))


def _has(row: Trial, *keys: str) -> bool:
    return all(isinstance(row.get(key), (int, float)) for key in keys)
