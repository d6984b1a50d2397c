"""The USME suite."""

from __future__ import annotations

from typing import Any

from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import flatten
from ms_slam_env.benchmark.report.glossary import Meanings, meaning
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.benchmark.report.kinds.scatter import scatter_plot

_MEASURES = (
    "ate_m", "ate_corrected_m", "ate_max_m", "end_error_m", "drift", "rpe_m", "rpe_rad", "lost",
    "robustness", "relocalisation_s", "initialisation_s", "scale_error", "c2c_mean_m",
    "hausdorff_m", "completion", "noise_ratio", "ext_ms", "ext_ms_p95", "cpu_ms_mean",
    "mem_peak_mb", "ene_frame_j",
)  # fmt: skip


class Usme(Kind):
    """``ms-slam usme``: the eight sequences of the USME framework."""

    name = "USME suite"
    about = (
        "Eight sequences over four kinds of scenes (streets, factory hall, room), with and "
        "without loops, motion blur, moving objects, fast motion and black frames, judged by the "
        "measures of the USME framework."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """A summary of rows with sequence, backend and robustness."""
        summary = content.get("summary")
        return (
            isinstance(summary, list)
            and bool(summary)
            and all(isinstance(r, dict) and {"sequence", "backend"} <= set(r) for r in summary)
            and any("robustness" in row for row in summary)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Every measure by sequence; error against time."""
        rows = [row for row in result.content["summary"] if row.get("error") is None]
        flat = [flatten(row) for row in rows]
        keys = [key for key in _MEASURES if len({str(row.get(key)) for row in flat}) > 1]
        runs = {
            backend: [
                (row["ext_ms"], row["ate_m"], str(row["sequence"]))
                for row in rows
                if row["backend"] == backend and row.get("ate_m") and row.get("ext_ms")
            ]
            for backend in dict.fromkeys(str(row["backend"]) for row in rows)
        }
        found = [bar_figure(flat, "Every sequence", ["sequence", "backend"], keys)]
        if any(runs.values()):
            plot = scatter_plot(runs, "ext_ms", "ate_m", medians=False)
            found.append(Figure("Error against time", "One mark a sequence.", (plot,), 440))
        return [figure for figure in found if figure is not None]

    def meanings(self, content: dict[str, Any]) -> Meanings:
        """Of the tables of the suite."""
        return (
            (r"noise \[%\]", meaning("noise_ratio")),
            (r"scene", "Kind of scene that the sequence was rendered in."),
            (r"95 % \[ms\]", "95th percentile of the execution time a frame, by the clock."),
            (r"mem \[mb\]", meaning("mem_peak_mb")),
        )
