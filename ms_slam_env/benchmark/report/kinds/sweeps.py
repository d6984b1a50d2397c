"""Results over a number: step sizes, frame skipping, training."""

from __future__ import annotations

from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.blocks import Figure, Plot
from ms_slam_env.benchmark.report.curves import curve_figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import flatten, records
from ms_slam_env.benchmark.report.glossary import heading, unit
from ms_slam_env.benchmark.report.kinds.base import Kind


class StepSize(Kind):
    """Planners with different step sizes."""

    name = "step size"
    about = "Planners whose motions are of different size: a long step shows more and loses more."

    def fits(self, content: dict[str, Any]) -> bool:
        """A summary of rows with planner and size."""
        summary = content.get("summary")
        return isinstance(summary, list) and all(
            isinstance(row, dict) and {"planner", "size"} <= set(row) for row in summary
        )

    def figures(self, result: Result) -> list[Figure]:
        """Every measure over the size."""
        rows = [flatten(row) for row in result.content["summary"]]
        keys = ["ate_m", "f_score_5cm", "lost", "rcm"]
        caption = "Size: cm of a translation and degrees of a rotation."
        found = curve_figure(rows, "size", "planner", keys, "Measures over the step size", caption)
        return [found] if found else []


class FrameSkipping(Kind):
    """Sequences of which only every n-th frame is taken."""

    name = "frame skipping"
    about = (
        "Only every n-th frame is given to SLAM: divergence between frames grows, time is saved, "
        "until tracking is lost."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """A summary by whole numbers, with divergences."""
        summary = content.get("summary")
        return (
            isinstance(summary, dict)
            and bool(summary)
            and all(key.isdigit() and isinstance(v, dict) for key, v in summary.items())
        )

    def figures(self, result: Result) -> list[Figure]:
        """Every measure over the interval."""
        rows = records(result.content["summary"], ["every"]) or []
        keys = ["ate_m", "lost", "mean_I", "mean_D", "M_I", "M_D"]
        found = curve_figure(rows, "every", None, keys, "Measures over the interval of frames")
        return [found] if found else []


class Training(Kind):
    """The learning curve of an agent."""

    name = "training"
    about = "An agent while it learns, judged on episodes it never trained on, beside baselines."

    def fits(self, content: dict[str, Any]) -> bool:
        """Points over timesteps."""
        points = content.get("points")
        return (
            isinstance(points, list)
            and bool(points)
            and all(isinstance(row, dict) and "timesteps" in row for row in points)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Every measure over timesteps; baselines as horizontal lines."""
        points = [flatten(row) for row in result.content["points"]]
        references = result.content.get("references") or {}
        found = []
        for key in points[0]:
            if key in ("timesteps", "minutes") or key.endswith("_sem"):
                continue
            found.append(_curve(points, references, key))
        caption = "Solid: the agent. Level lines: baselines in the same episodes."
        return [Figure("Learning curve", caption, tuple(found))] if found else []


def _curve(points: list[Any], references: dict[str, Any], key: str) -> Plot:
    _, scale = unit(key)

    def scaled(value: Any) -> float | None:
        return scale * value if isinstance(value, (int, float)) else None

    x = [float(row["timesteps"]) for row in points]
    agent = plots.line("agent", x, [scaled(row.get(key)) for row in points], 0)
    data = [{**agent, "mode": "lines+markers"}]
    errors = [row.get(f"{key}_sem") for row in points]
    if all(isinstance(error, (int, float)) for error in errors):
        data[0]["error_y"] = {"type": "data", "array": plots.finite(map(scaled, errors))}
    for index, (name, values) in enumerate(references.items(), start=1):
        level = scaled(values.get(key)) if isinstance(values, dict) else None
        if level is not None:
            line = plots.line(name, [x[0], x[-1]], [level, level], index)
            line["line"]["dash"] = plots.dash(index)
            data.append(line)
    axes = plots.axis("timesteps"), plots.axis(heading(key))
    return Plot(heading(key), data, plots.layout(*axes, showlegend=True))
