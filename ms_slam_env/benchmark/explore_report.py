"""Tables of an exploration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ms_slam_env.benchmark.explore_judge import FIGURES
from ms_slam_env.exploration.objectives import METRICS
from ms_slam_env.report.tables import format_number, markdown_table

_SHOWN = ("ate_m", "ate_max_m", "ext_ms", "mem_mb", "energy_j", "map_error_mm", "M_I", "M_D")


def table(content: Mapping[str, Any]) -> str:
    """The default, the chosen configurations and the front; held-out figures; importances."""
    trials = content["trials"]
    counts = (
        f"{len(trials)} finished trials, "
        f"{sum(bool(row.get('failure')) for row in trials)} of them failed, "
        f"{sum(row['feasible'] for row in trials)} feasible, "
        f"{sum(row['on_front'] for row in trials)} on the front; "
        f"hypervolume {format_number(content['hypervolume'][-1], 3)} of the box up to "
        + ", ".join(f"{k} = {format_number(v, 3)}" for k, v in content["reference"].items())
        + ".\n"
    )
    return "\n".join(
        part
        for part in (
            counts,
            _configurations(content),
            _held_out(content["held_out"]),
            _importance(content["importance"]),
        )
        if part
    )


def _configurations(content: Mapping[str, Any]) -> str:
    trials = content["trials"]
    names: dict[int, list[str]] = {}
    for row in trials:
        if row["default"]:
            names.setdefault(row["trial"], []).append("default")
    for name, row in content["chosen"].items():
        names.setdefault(row["trial"], []).append(name.replace("_", " "))
    shown = [row for row in trials if row["on_front"] or row["trial"] in names]
    shown.sort(key=lambda row: row.get(content["objectives"][1]) or 0.0)
    figures = [name for name in _SHOWN if any(row.get(name) is not None for row in shown)]
    parameters = list(content["config"]["parameters"])
    header = ["trial", "which", *figures, *parameters]
    return markdown_table(
        header,
        [
            [
                str(row["trial"]),
                ", ".join(names.get(row["trial"], ["front"])),
                *(_number(row.get(name)) for name in figures),
                *(_number(row["params"][name]) for name in parameters),
            ]
            for row in shown
        ],
    )


def _held_out(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    header = ["held-out sequences"]
    for name in FIGURES:
        header += [METRICS[name].label, "of default's"]
    body = []
    for row in rows:
        cells = [row["configuration"].replace("_", " ")]
        for name in FIGURES:
            cells += [_number(row[name]), _ratio(row, name)]
        body.append([*cells, f"{row['failed']} of {row['sequences']}"])
    return markdown_table([*header, "failed"], body)


def _importance(importance: Mapping[str, Mapping[str, float]]) -> str:
    if not importance:
        return ""
    names = sorted(
        next(iter(importance.values())), key=lambda name: -max(i[name] for i in importance.values())
    )
    header = ["importance of", *(METRICS[name].label for name in importance)]
    return markdown_table(
        header,
        [[name, *(f"{shares[name]:.2f}" for shares in importance.values())] for name in names],
    )


def _ratio(row: Mapping[str, Any], name: str) -> str:
    values = [row[f"{name}_ratio{end}"] for end in ("", "_low", "_high")]
    if any(value is None for value in values):
        return "-"
    value, low, high = (format_number(value, 2) for value in values)
    return f"{value} [{low}, {high}]"


def _number(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return str(value) if isinstance(value, int) else format_number(value, 3)
    return str(value)
