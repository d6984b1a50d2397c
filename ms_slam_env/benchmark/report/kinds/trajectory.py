"""One SLAM run, and a trajectory against the truth."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import measures
from ms_slam_env.benchmark.report.blocks import Figure, Plot
from ms_slam_env.benchmark.report.curves import curve_figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten
from ms_slam_env.benchmark.report.glossary import Meanings
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.errors import InputError
from ms_slam_env.geometry.point_clouds import umeyama
from ms_slam_env.sequences import associate, read_trajectory

Float64 = NDArray[np.float64]

_MAX_POINTS = 3000
_MAX_DIFFERENCE_S = 0.02
ESTIMATE, TRUTH = "evaluation.estimate.txt", "evaluation.truth.txt"
"""What ``ms-slam evaluate`` leaves: the poses that correspond, aligned."""

_COSTS = {"cpu_ms": "processor time [ms]", "ext_ms": "EXT [ms]", "mem_mb": "memory [MB]"}


class Run(Kind):
    """``ms-slam run``: a backend over one sequence."""

    name = "SLAM over one sequence"
    about = "A SLAM backend over a recorded sequence: its path, its error, what each frame cost."

    def fits(self, content: dict[str, Any]) -> bool:
        """Metrics of a run, finished or not."""
        return {"complete", "frames", "backend", "sequence"} <= set(content)

    def figures(self, result: Result) -> list[Figure]:
        """Path from above, error over time, cost over time."""
        folder = result.folder
        estimates = {
            "estimate": folder / "trajectory.txt",
            "estimate, loops closed": folder / "trajectory.corrected.txt",
        }
        found = trajectory_figures(folder / "groundtruth.txt", estimates)
        costs = cost_figure(folder / "frames.csv")
        return [*found, *([costs] if costs else [])]

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """Times of a run."""
        return (
            (r"ms (median|p95)", "Processor time a frame: median, 95th percentile."),
            (r"mem( mb| \[mb\])", "Memory that SLAM itself took, mean over the frames."),
        )


class Evaluation(Kind):
    """``ms-slam evaluate``: an estimated trajectory against the truth."""

    name = "trajectory against the truth"
    about = (
        "Absolute error (ATE) after alignment, and relative error (RPE) of the motion between "
        "two poses; root mean square and other statistics."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Statistics of a trajectory or of a map, with the names of both files."""
        names = set(content)
        return {"estimate", "truth", "ate_m"} <= names or {"map", "true_map", "register"} <= names

    def figures(self, result: Result) -> list[Figure]:
        """Path from above, error over time, error by piece, drift by length."""
        content, folder = result.content, result.folder
        found = trajectory_figures(folder / TRUTH, {"estimate": folder / ESTIMATE}, "none")
        if not found and "estimate" in content:  # of another program: the files as they were
            files = Path(str(content["truth"])), Path(str(content["estimate"]))
            found = trajectory_figures(files[0], {"estimate": files[1]}, str(content.get("align")))
        pieces = [flatten(row) for row in content.get("segments") or ()]
        keys = [f"{error}.rmse" for error in ("ate_m", "rpe_m", "ate_rad", "rpe_rad")]
        drift = [flatten(row) for row in content.get("drift") or ()]
        more = [
            curve_figure(pieces, "start_s", None, keys, "Error by piece", "RMSE of each piece.")
            if len(pieces) > 1
            else None,
            curve_figure(
                drift, "length_m", None, _drifts(drift), "Drift over lengths of the true path"
            )
            if len(drift) > 1
            else None,
        ]
        return [*found, *(figure for figure in more if figure is not None)]

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """Of the table of errors."""
        return ((r"error", "Which measure of the error the row holds."),)


def trajectory_figures(truth: Path, estimates: dict[str, Path], align: str = "se3") -> list[Figure]:
    """Path from above and error over time; empty without an estimate.

    Args:
        truth: TUM file; without it estimates are drawn as they are.
        estimates: TUM files by name; those that do not exist are left out.
        align: se3, sim3 or none.
    """
    true = _read(truth)
    read = {name: _read(path) for name, path in estimates.items()}
    known = {name: track for name, track in read.items() if track is not None}
    if not known:
        return []
    errors: list[dict[str, Any]] = []
    lines: dict[str, Float64] = {} if true is None else {"truth": true[1]}
    for index, (name, (times, points)) in enumerate(known.items(), start=1):
        if true is not None:
            first, second = associate(times, true[0], _MAX_DIFFERENCE_S)
            if len(first) >= 2:
                if align != "none":
                    points = _aligned(points, points[first], true[1][second], align)
                distance = 1e3 * np.linalg.norm(points[first] - true[1][second], axis=1)
                picked = _thin(len(first))
                seconds = (times[first] - times[0])[picked]
                errors.append(plots.line(name, seconds.tolist(), distance[picked].tolist(), index))
        lines[name] = points
    found = [_top_view(lines)]
    if errors:
        axes = plots.axis("time [s]"), plots.axis("position error [mm]", rangemode="tozero")
        layout = plots.layout(*axes, showlegend=len(errors) > 1)
        caption = "Distance from the true position."
        if align != "none":
            caption = f"Distance from the true position after alignment ({align})."
        found.append(Figure("Error over time", caption, (plots.plot(errors, layout),)))
    return found


def cost_figure(path: Path) -> Figure | None:
    """What each frame cost, from ``frames.csv``; None without it."""
    if not path.is_file():
        return None
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    found = []
    for key, title in _COSTS.items():
        values = [_number(row.get(key)) for row in rows]
        if not any(values):
            continue
        picked = range(0, len(rows), max(1, len(rows) // _MAX_POINTS))
        frames = [float(k) for k in picked]
        data = [plots.line(title, frames, [values[k] for k in picked], 0)]
        lost = [k for k in picked if rows[k].get("tracking_ok") == "0"]
        if lost:
            marks = plots.line("lost", [float(k) for k in lost], [values[k] for k in lost], 6)
            data.append({**marks, "mode": "markers"})
        layout = plots.layout(
            plots.axis("frame"), plots.axis(title, rangemode="tozero"), showlegend=bool(lost)
        )
        found.append(Plot(title, data, layout))
    return Figure("Cost of every frame", "", tuple(found), 340) if found else None


def _top_view(lines: dict[str, Float64]) -> Figure:
    """The two axes along which the paths extend furthest, both of the same scale."""
    everything = np.concatenate(list(lines.values()))
    a, b = sorted(np.argsort(np.ptp(everything, axis=0))[-2:].tolist())
    data = []
    for index, (name, points) in enumerate(lines.items()):
        shown = points[_thin(len(points))]
        index = index if "truth" in lines else index + 1
        trace = plots.line(name, shown[:, a].tolist(), shown[:, b].tolist(), index)
        trace["line"]["dash"] = "dot" if name == "truth" else "solid"
        data.append(trace)
    x = plots.axis(f"{'xyz'[a]} [m]", constrain="domain")
    y = plots.axis(f"{'xyz'[b]} [m]", scaleanchor="x", constrain="domain")
    layout = plots.layout(x, y, showlegend=True)
    caption = "The two directions in which the path extends furthest."
    return Figure("Path", caption, (plots.plot(data, layout),), 460)


def _drifts(rows: list[Record]) -> list[str]:
    """The drifts among the measures of segments."""
    return [key for key in measures(rows) if "." in key]


def _read(path: Path) -> tuple[Float64, Float64] | None:
    """Times (N,) and positions (N, 3) of a TUM file; None without one that can be read."""
    try:
        times, poses = read_trajectory(path)
    except (InputError, OSError):
        return None
    return (times, poses[:, :3, 3]) if len(times) else None


def _aligned(points: Float64, first: Float64, second: Float64, align: str) -> Float64:
    R, t, scale = umeyama(first, second, with_scale=align == "sim3")
    moved: Float64 = scale * points @ R.T + t
    return moved


def _thin(count: int) -> slice:
    return slice(None, None, max(1, count // _MAX_POINTS))


def _number(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None
