"""Paths and errors of trajectories as panels of charts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.report.charts import Panel, Series

MOST_POINTS = 1000
"""Largest number of points in a line: more cannot be distinguished on a screen."""


def thinned(count: int, most: int = MOST_POINTS) -> NDArray[np.int64]:
    """At most ``most`` of ``count`` indices, evenly spaced."""
    return np.arange(0, count, max(1, -(-count // most)))


def widest_axes(points: Float64) -> tuple[int, int]:
    """The two axes, in order, along which points (N, 3) extend most: usually the horizontal ones.

    Which axis points up differs between data sets, and no file states it.
    """
    extent = np.nanmax(points, axis=0) - np.nanmin(points, axis=0)
    a, b = sorted(np.argsort(extent, stable=True)[-2:].tolist())
    return a, b


def path_panel(paths: Mapping[str, Float64]) -> Panel:
    """Positions (N, 3) by name, drawn at one scale along the two axes of largest extent.

    A line is interrupted where a row is NaN.
    """
    a, b = widest_axes(np.concatenate(list(paths.values())))
    series = [_line(name, points[:, a], points[:, b]) for name, points in paths.items()]
    return Panel(f"position_{'xyz'[a]}_m", f"position_{'xyz'[b]}_m", series, equal=True)


def error_panel(key: str, times: Float64, errors: Mapping[str, Float64]) -> Panel:
    """Errors (N,) of metric ``key`` by name over times (N,) in seconds since the start."""
    return Panel("since_start_s", key, [_line(name, times, e) for name, e in errors.items()])


def marked_panel(key: str, values: Float64, lost: NDArray[np.int64]) -> Panel:
    """Metric ``key`` (N,) over the frames; the frames in ``lost`` (K,) are marked."""
    picked = thinned(len(values))
    series = [Series("all", picked.tolist(), values[picked].tolist(), mode="lines")]
    if len(lost):
        shown = lost[thinned(len(lost))]
        series.append(Series("lost", shown.tolist(), values[shown].tolist(), mode="markers"))
    return Panel("frame", key, series)


def _line(name: str, x: Float64, y: Float64) -> Series:
    picked = thinned(len(x))
    return Series(name, x[picked].tolist(), y[picked].tolist(), mode="lines")
