"""Error against cost: a small mark a run, a large one the median of those that compete."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.blocks import Plot
from ms_slam_env.benchmark.report.glossary import heading, unit

Points = Sequence[tuple[float, float, str]]


def scatter_plot(
    runs: Mapping[str, Points], x: str, y: str, label: str = "", medians: bool = True
) -> Plot:
    """A plot of ``runs``: name -> (x, y, text) of each run, in the units of the keys ``x``, ``y``.

    An axis is logarithmic where its values spread far.
    """
    (_, x_scale), (_, y_scale) = unit(x), unit(y)
    data: list[dict[str, Any]] = []
    for index, (name, points) in enumerate(runs.items()):
        xs = [x_scale * point[0] for point in points]
        ys = [y_scale * point[1] for point in points]
        marker = {"color": plots.colour(index), "symbol": plots.symbol(index)}
        trace = {
            "type": "scatter",
            "name": plots.short(name),
            "legendgroup": str(index),
            "mode": "markers",
        }
        data.append(
            {
                **trace,
                "x": plots.finite(xs),
                "y": plots.finite(ys),
                "text": [plots.text(point[2]) for point in points],
                "marker": {**marker, "size": 7 if medians else 10, "opacity": 0.55},
                "showlegend": not medians,
                "hovertemplate": "%{text}<br>%{x:.4g}, %{y:.4g}<extra>%{fullData.name}</extra>",
            }
        )
        if medians and points:
            data.append(
                {
                    **trace,
                    "x": plots.finite([float(np.median(xs))]),
                    "y": plots.finite([float(np.median(ys))]),
                    "marker": {**marker, "size": 14, "line": {"width": 1.5, "color": "#ffffff"}},
                    "hovertemplate": "median: %{x:.4g}, %{y:.4g}<extra>%{fullData.name}</extra>",
                }
            )
    every = [point for points in runs.values() for point in points]
    axes = (
        plots.axis(heading(x), plots.wide_range(point[0] for point in every)),
        plots.axis(heading(y), plots.wide_range(point[1] for point in every)),
    )
    return Plot(label, data, plots.layout(*axes, showlegend=True))
