"""Compare episodes that use the pose from SLAM, from the arm's kinematics, and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ms_slam_env.benchmark.episodes import DOTS, SteppedExperiment, parse_options
from ms_slam_env.benchmark.experiment import check_each
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, by_group
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import Interval, relative_cut
from ms_slam_env.report.tables import Grouping, Table, complete_cases, grouped, make_table, measured

REFERENCE = "slam"
"""Reference source, with which the others are compared episode by episode."""
METRICS = (
    *("ate_m", "ate_tracked_m", "tracked_share", "ate_unaligned_m", "rpe_m"),
    *("f_score_2cm", "f_score_5cm", "rcm", "lost"),
)
EVERYWHERE = "all"
_DIGITS = 9  # nanometres, the rounding error of zero after an alignment


@dataclass(frozen=True)
class PoseSourceExperiment(SteppedExperiment):
    """The same episodes with the pose from SLAM, kinematics, both, and the truth

    Measures how much the estimated pose costs the map, and the planner that uses the map.
    """

    sources: tuple[str, ...] = tuple(POSE_SOURCES)
    """Sources of the pose."""
    planners: tuple[str, ...] = ("random", "greedy")
    """Planners, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = ("living_room", "table", "wall", "carpet")
    episodes: int = 5
    steps: int = 60
    seeds: str = "test"
    env_id: str = "MSActiveSLAM-v0"
    """The environment."""

    def __post_init__(self) -> None:
        """Refuse unknown or repeated sources."""
        check_each("source", self.sources, POSE_SOURCES)

    def compared(self) -> Sequence[Mapping[str, Any]]:
        """Every planner with every source."""
        options = parse_options(self.options)
        if "pose" in options:
            raise InputError("option 'pose' cannot be set: the benchmark sets it")
        return [
            {"planner": planner, "options": {**options, "pose": source}}
            for planner in self.planners
            for source in self.sources
        ]

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per scene (all together last), planner and source."""
        common = compared(rows)
        everywhere = [{**r, "spec": {**r["spec"], "scene": EVERYWHERE}} for r in common]
        by_scene = sorted(common, key=lambda row: self.scenes.index(row["spec"]["scene"]))
        every = by_scene + everywhere
        fields = ("scene", "planner", "pose_source")
        medians = Grouping(fields, METRICS, count="episodes").table(every)
        results = grouped(every, fields)
        lines: list[dict[str, Any]] = []
        for line in medians.rows:
            scene, planner, source = (line[name] for name in fields)
            episodes = results[scene, planner, source]
            reference = results.get((scene, planner, REFERENCE), [])
            lines.append({**line, "ate_ratio": _ratio(episodes, reference)})
        note = (
            "Medians (of losses: the share) with 95 % intervals, over the episodes that every "
            f"source finished; pose source {REFERENCE} is the unit of the ATE ratio."
        )
        return [make_table([*medians.columns, "ate_ratio"], lines, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Errors and the map's F-score of every episode, by source."""
        panels = by_group(
            compared(rows), "pose_source", ("ate_unaligned_m", "rpe_m", "f_score_2cm")
        )
        return [Chart("pose_sources", "Measures by source of the pose", DOTS, panels)]


def compared(rows: Sequence[Row]) -> list[Row]:
    """Rows of the episodes that every source finished, with ``pose_source`` in the spec.

    Values of single episodes are rounded to nanometres, to remove rounding errors.
    """
    named = [
        {**row, "spec": {**row["spec"], "pose_source": row["spec"]["options"]["pose"]}}
        for row in rows
    ]
    known = measured(METRICS, rows)
    common = complete_cases(named, ("planner", "scene", "seed"), "pose_source")
    return [
        {**row, "result": {key: _rounded(row["result"][key]) for key in known}}
        for row in sorted(common, key=lambda row: (row["spec"]["scene"], row["spec"]["seed"]))
    ]


def _rounded(value: float | bool | None) -> float | bool | None:
    return value if isinstance(value, bool) or value is None else round(value, _DIGITS)


def _ratio(
    episodes: Sequence[Mapping[str, Any]], reference: Sequence[Mapping[str, Any]]
) -> Interval | None:
    """Median ATE divided by the reference's, over the same episodes."""
    if not reference:
        return None
    cut = relative_cut([e["ate_m"] for e in episodes], [e["ate_m"] for e in reference])
    return Interval(1 - cut.value, 1 - cut.high, 1 - cut.low)
