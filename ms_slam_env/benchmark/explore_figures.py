"""Figures of an exploration: Pareto front (Fig. 6), hypervolume, importance of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ms_slam_env.benchmark.figures import caption, legend_beside, new_figure, plain_log_ticks, save
from ms_slam_env.exploration.objectives import FAILURE, METRICS

_FRONT, _OTHERS, _DEFAULT = "#2a8c2a", "#7aa6d6", "black"
_MARKS = {"fastest": ">", "most_accurate": "v", "knee": "s"}


def save_figures(content: Mapping[str, Any], out: Path) -> list[Path]:
    """Draw every figure into folder ``out``; return their paths."""
    figures = {
        "pareto.png": pareto_figure(content),
        "hypervolume.png": hypervolume_figure({"": [content["hypervolume"]]}),
    }
    if content["importance"]:
        figures["importance.png"] = importance_figure(content["importance"])
    return [save(figure, out / name) for name, figure in figures.items()]


def pareto_figure(content: Mapping[str, Any]) -> Figure:
    """Every trial, the front in green and the default as a black diamond, as in Fig. 6."""
    error, cost = content["objectives"][:2]
    rows = [r for r in content["trials"] if r.get(error) is not None and r.get(cost) is not None]
    figure = new_figure(width=5.2, height=4.0)
    ax = figure.subplots()
    plain = [r for r in rows if r["feasible"] and not r["on_front"]]
    refused = [r for r in rows if not r["feasible"] and not r.get(FAILURE)]
    failed = [r for r in rows if r.get(FAILURE)]
    ax.scatter(*_xy(plain, cost, error), s=14, color=_OTHERS, label="trial")
    if refused:
        ax.scatter(
            *_xy(refused, cost, error), s=16, facecolors="none", edgecolors="0.5",
            label="breaks a constraint",
        )  # fmt: skip
    if failed:
        ax.scatter(*_xy(failed, cost, error), s=18, marker="x", color="#c44", label="failed")
    front = sorted((r for r in rows if r["on_front"]), key=lambda row: row[cost])
    if front:
        ax.plot(*_xy(front, cost, error), "o-", ms=4, color=_FRONT, label="Pareto front")
    for name, row in content["chosen"].items():
        ax.scatter(
            [row[cost]], [row[error]], s=70, marker=_MARKS[name], facecolors="none",
            edgecolors=_FRONT, linewidths=1.5, label=name.replace("_", " "),
        )  # fmt: skip
    default = [r for r in rows if r["default"]]
    ax.scatter(*_xy(default, cost, error), s=60, marker="D", color=_DEFAULT, label="default")
    ax.set(xscale="log", yscale="log", xlabel=METRICS[cost].label, ylabel=METRICS[error].label)
    plain_log_ticks(ax.xaxis)
    plain_log_ticks(ax.yaxis)
    legend_beside(figure, ax)
    return figure


def hypervolume_figure(histories: Mapping[str, Sequence[Sequence[float]]]) -> Figure:
    """Hypervolume over finished trials; of several runs the mean with its 95 % interval."""
    figure = new_figure(width=4.6, height=3.4)
    ax = figure.subplots()
    for name, runs in histories.items():
        values = np.array(runs, dtype=np.float64)
        trials = np.arange(1, values.shape[1] + 1)
        mean = values.mean(axis=0)
        (line,) = ax.plot(trials, mean, label=name)
        if len(values) > 1:
            half = 1.96 * values.std(axis=0, ddof=1) / np.sqrt(len(values))
            ax.fill_between(trials, mean - half, mean + half, color=line.get_color(), alpha=0.15)
    ax.set(xlabel="finished trials", ylabel="hypervolume")
    if any(histories):
        caption(figure, "mean and 95 % interval over the runs of each sampler")
        ax.legend(fontsize="small")
    return figure


def importance_figure(importance: Mapping[str, Mapping[str, float]]) -> Figure:
    """Bars: share of each parameter in what makes a good value of each objective."""
    names = sorted(
        next(iter(importance.values())), key=lambda name: max(i[name] for i in importance.values())
    )
    figure = new_figure(width=5.2, height=1.2 + 0.28 * len(names))
    ax = figure.subplots()
    places = np.arange(len(names))
    height = 0.8 / len(importance)
    for index, (objective, shares) in enumerate(importance.items()):
        ax.barh(
            places + (index - (len(importance) - 1) / 2) * height,
            [shares[name] for name in names],
            height,
            label=METRICS[objective].label,
        )
    ax.set_yticks(places, names)
    ax.set_xlabel("importance (PED-ANOVA)")
    ax.legend(fontsize="small")
    return figure


def _xy(rows: Sequence[Mapping[str, Any]], x: str, y: str) -> tuple[list[float], list[float]]:
    return [row[x] for row in rows], [row[y] for row in rows]
