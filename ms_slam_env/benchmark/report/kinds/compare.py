"""The comparison of SLAM backends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure, Plot
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import flatten
from ms_slam_env.benchmark.report.kinds.base import Kind

_MEASURES = (
    "ate_m", "cpu_ms", "map_error_mm", "f_5cm", "f_2cm", "precision_5cm", "precision_2cm",
    "ate_max_m", "ate_unaligned_m", "rpe_m", "rpe_rad", "lost", "cpu_ms_p95", "ext_ms", "ms",
    "memory_mb", "mem_mb", "ene_j", "points",
)  # fmt: skip


class Comparison(Kind):
    """``ms-slam compare``: SLAM backends over the same sequences."""

    name = "comparison of SLAM backends"
    about = (
        "Every backend runs over the same images; its error is set against the time it takes. "
        "Down and left is good."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """A summary of rows with backend, sequence, error and time."""
        summary = content.get("summary")
        return (
            isinstance(summary, list)
            and bool(summary)
            and all(
                isinstance(row, dict) and {"backend", "sequence", "image_size"} <= set(row)
                for row in summary
            )
        )

    def figures(self, result: Result) -> list[Figure]:
        """Error against time; every measure by sequence, an image size at a time."""
        rows = [row for row in result.content["summary"] if row.get("error") is None]
        found = [error_against_time(rows)]
        sizes = list(dict.fromkeys(row["image_size"] for row in rows))
        for size in sizes:
            own = [flatten(row) for row in rows if row["image_size"] == size]
            keys = [key for key in _MEASURES if len({row.get(key) for row in own}) > 1]
            title = f"Every sequence, {size}"
            found.append(bar_figure(own, title, ["sequence", "backend"], keys))
        return [figure for figure in found if figure is not None]


def error_against_time(rows: Sequence[dict[str, Any]]) -> Figure | None:
    """A mark for each sequence and backend; image sizes to choose from."""
    done = [row for row in rows if (row.get("ate_m") or 0) > 0 and (row.get("cpu_ms") or 0) > 0]
    if not done:
        return None
    backends = list(dict.fromkeys(row["backend"] for row in done))
    found = []
    for size in dict.fromkeys(row["image_size"] for row in done):
        data = []
        for index, backend in enumerate(backends):
            own = [r for r in done if (r["image_size"], r["backend"]) == (size, backend)]
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": plots.short(backend),
                    "x": plots.finite(row["cpu_ms"] for row in own),
                    "y": plots.finite(1e3 * row["ate_m"] for row in own),
                    "text": [plots.text(row["sequence"]) for row in own],
                    "marker": {
                        "color": plots.colour(index),
                        "symbol": plots.symbol(index),
                        "size": 10,
                        "opacity": 0.8,
                    },
                    "hovertemplate": "%{text}<br>%{x:.3g} ms, ATE %{y:.3g} mm"
                    "<extra>%{fullData.name}</extra>",
                }
            )
        layout = plots.layout(
            plots.axis("processor time [ms a frame]", log=True), plots.axis("ATE [mm]", log=True)
        )
        found.append(Plot(size, data, layout))
    return Figure("Error against time", "One mark a sequence.", tuple(found), 440, "Image size")
