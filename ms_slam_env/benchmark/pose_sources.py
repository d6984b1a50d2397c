"""What SLAM's pose costs against the arm's kinematics and against the truth.

The same episodes with each source of the pose. Run as
``python -m ms_slam_env.benchmark.pose_sources --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.planner_report import Column, finished
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.env.pose_sources import POSE_SOURCES
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.experiments.harness.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    EpisodeSpec,
    check_episodes,
    check_names,
    parse_options,
    run_episode,
    seed_list,
)
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report import statistics
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, markdown_table

PROGRAM = "python -m ms_slam_env.benchmark.pose_sources"
REFERENCE = "slam"
"""The source that the others are compared with, episode by episode."""

COLUMNS = (
    Column("ate_m", "ATE [mm]", 1000),
    Column("ate_unaligned_m", "ATE unaligned [mm]", 1000),
    Column("rpe_m", "RPE [mm]", 1000),
    Column("f_score_2cm", "F-score 2 cm [%]", 100),
    Column("f_score_5cm", "F-score 5 cm [%]", 100),
    Column("rcm", "RCM [%]", 100),
)
EVERYWHERE = "all"
_DIGITS = 9  # nanometres: what is left of zero after an alignment
Summary = dict[str, dict[str, dict[str, dict[str, Any]]]]


@dataclass(frozen=True)
class Arguments:
    """The same episodes with the pose from SLAM, kinematics, both, and the truth."""

    sources: tuple[str, ...] = tuple(POSE_SOURCES)
    """Sources of the pose."""
    planners: tuple[str, ...] = ("random", "greedy")
    """Planners, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = ("living_room", "table", "wall", "carpet")
    """Names of scenes, or mesh files."""
    episodes: int = 5
    """Seeds for each scene."""
    steps: int = 60
    """Length of an episode."""
    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
    env_id: str = "MSActiveSLAM-v0"
    """The environment."""
    seeds: str = "test"
    """Split that the seeds come from."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in arm.frames_per_action=1."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/pose_sources")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse unknown or repeated sources."""
        if not self.sources or len(set(self.sources)) < len(self.sources):
            raise InputError(f"sources {', '.join(self.sources)!r} must be different, at least one")
        for source in self.sources:
            if source not in POSE_SOURCES:
                raise unknown("source of the pose", source, POSE_SOURCES)

    def specs(self) -> list[EpisodeSpec]:
        """Every episode; those of one scene and seed are neighbours and share its geometry."""
        options = parse_options(self.options)
        if "pose" in options:
            raise InputError("option 'pose' is not free: the benchmark sets it")
        return [
            EpisodeSpec(
                planner,
                scene,
                seed,
                self.env_id,
                steps=self.steps,
                step_m=self.step_m,
                step_deg=self.step_deg,
                options={**options, "pose": source},
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for planner in self.planners
            for source in self.sources
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(args.planners, args.scenes)
    check_episodes(args.specs())
    rows = run_all(args.specs(), run_episode, args.out, args.workers)
    check_any_finished(rows)
    summary = compare(rows, (*args.scenes, EVERYWHERE))
    content = {
        "provenance": provenance(),
        "config": asdict(args) | {"out": str(args.out)},
        "summary": summary,
        "episodes": rows,
    }
    write_json(args.out / "pose_sources.json", content)
    table = as_table(summary)
    (args.out / "table.md").write_text(table)
    print(table)
    return report_failures(failures(rows), PROGRAM)


def compare(rows: Sequence[Row], places: Sequence[str]) -> Summary:
    """Medians by scene (``all`` for all together), planner and source.

    Only episodes that every source finished without an error are compared. ``ate_ratio`` is the
    median ATE in units of that of the source ``slam``.
    """
    results: dict[tuple[str, str], dict[tuple[str, int], dict[str, Any]]] = {}
    for row in finished(rows):
        spec = row["spec"]
        cell = results.setdefault((spec["planner"], spec["options"]["pose"]), {})
        cell[spec["scene"], spec["seed"]] = row["result"]
    planners = list(dict.fromkeys(planner for planner, _ in results))
    sources = list(dict.fromkeys(source for _, source in results))
    summary: Summary = {}
    for place in places:
        for planner in planners:
            cells = [results.get((planner, source), {}) for source in sources]
            common = sorted(set.intersection(*map(set, cells)))
            keys = [key for key in common if place in (EVERYWHERE, key[0])]
            by_source = {
                source: [cell[key] for key in keys]
                for source, cell in zip(sources, cells, strict=True)
            }
            reference = by_source.get(REFERENCE)
            summary.setdefault(place, {})[planner] = {
                source: _cell(episodes, reference) for source, episodes in by_source.items()
            }
    return summary


def _cell(episodes: list[dict[str, Any]], reference: list[dict[str, Any]] | None) -> dict[str, Any]:
    """Medians of one scene, planner and source as plain numbers."""

    def values(metric: str, of: list[dict[str, Any]] = episodes) -> list[float]:
        return [round(e[metric], _DIGITS) for e in of]

    cell = {column.metric: statistics.median_interval(values(column.metric)) for column in COLUMNS}
    cell["lost"] = statistics.share_interval([e["lost"] for e in episodes])
    cell["ate_ratio"] = Interval(float("nan"), float("nan"), float("nan"))
    if reference:
        cut = statistics.relative_cut(values("ate_m"), values("ate_m", reference))
        cell["ate_ratio"] = Interval(1 - cut.value, 1 - cut.high, 1 - cut.low)
    return {"episodes": len(episodes)} | {name: asdict(value) for name, value in cell.items()}


def as_table(summary: Summary) -> str:
    """Markdown: one line a scene, planner and source."""
    body = []
    for place, planners in summary.items():
        for planner, sources in planners.items():
            for source, cell in sources.items():
                shown = [format_interval(Interval(**cell[c.metric]), c.scale) for c in COLUMNS]
                lost = format_interval(Interval(**cell["lost"]), 100)
                ratio = format_interval(Interval(**cell["ate_ratio"]))
                count = str(cell["episodes"])
                body.append([place, planner, source, count, *shown, lost, ratio])
    headings = [column.heading for column in COLUMNS]
    last = ["lost [%]", f"ATE / {REFERENCE}'s"]
    return markdown_table(["scene", "planner", "pose from", "episodes", *headings, *last], body)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
