"""Experiment (a): at which step size does each planner lose tracking?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ms_slam_env.benchmark.episodes import DEFAULT_PLANNERS, EpisodeExperiment, short_planner_names
from ms_slam_env.report.charts import Chart, over_field
from ms_slam_env.report.tables import Grouping, Row, Table

METRICS = ("lost", "ate_m", "ate_tracked_m", "tracked_share", "f_score_5cm", "rcm")
_PANELS = ("lost", "ate_m", "f_score_5cm", "rcm")


@dataclass(frozen=True)
class StepSize(EpisodeExperiment):
    """Planners with motions of different size

    Steps are s cm and s degrees, with the same number of steps for every size. A larger step shows
    more, but tracking is lost more easily.
    """

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = ("living_room", "table")
    sizes: tuple[float, ...] = (2, 4, 6, 8, 10, 12)
    """Step sizes s: s centimetres and s degrees."""
    episodes: int = 5
    steps: int = 80
    seeds: str = "validation"
    """Split that the seeds come from; do not derive defaults from test seeds."""

    def compared(self) -> Sequence[Mapping[str, Any]]:
        """Every planner with every step size."""
        return [
            {"planner": planner, "step_m": size / 100, "step_deg": size}
            for size in self.sizes
            for planner in self.planners
        ]

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per planner and size."""
        note = "Medians (of losses: the share) over episodes with their 95 % intervals."
        return [Grouping(("planner", "step_deg"), METRICS).table(rows, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """One panel per metric, one line per planner."""
        label = short_planner_names(row["spec"]["planner"] for row in rows).__getitem__
        panels = over_field(rows, "step_deg", _PANELS, "planner", log=("ate_m",), label=label)
        caption = "Mark: median over episodes (losses: their share); band: its 95 % interval."
        return [Chart("step_size", "Measures over the step size", caption, panels)]
