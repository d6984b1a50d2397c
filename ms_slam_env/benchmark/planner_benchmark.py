"""The planner benchmark: scenes x seeds x planners, every planner from the same start pose."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark import planner_report
from ms_slam_env.benchmark.episode import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    EpisodeSpec,
    check_episodes,
    run_episode,
)
from ms_slam_env.benchmark.options import parse_options
from ms_slam_env.benchmark.planners import check_planner
from ms_slam_env.benchmark.runner import check_any_finished, failures, run_all
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.scenes import SCENES, SEED_SPLITS
from ms_slam_env.scenes.mesh_file import load_soup
from ms_slam_env.scenes.registry import check_name

DEFAULT_PLANNERS = ("random", "stationary", "greedy", "max-information")
DEFAULT_SCENES = ("living_room", "corridor", "table", "wall")


@dataclass(frozen=True)
class PlannerBenchmark:
    """What to run.

    Attributes:
        planners: each ``NAME`` or ``module:Class``, options appended as ``,option=value``.
        scenes: names of scenes or paths of meshes.
        episodes: seeds for each scene, the first of the split.
        steps: length of an episode.
        step_m: translation of a motion, metres.
        step_deg: rotation of a motion, degrees.
        env_id: environment.
        seeds: split that the seeds come from: train, validation or test.
        options: of the environment, as in ``lookahead.reference=live``.
    """

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    scenes: tuple[str, ...] = DEFAULT_SCENES
    episodes: int = 10
    steps: int = 100
    step_m: float = DEFAULT_STEP_M
    step_deg: float = DEFAULT_STEP_DEG
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    seeds: str = "test"
    options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse bad values before anything runs."""
        check_names(self.planners, self.scenes)
        seed_list(self.seeds, self.episodes)
        self.specs()

    def specs(self) -> list[EpisodeSpec]:
        """Every episode; those of one scene and seed are neighbours and share its geometry."""
        return [
            EpisodeSpec(
                planner=planner,
                scene=scene,
                seed=seed,
                env_id=self.env_id,
                steps=self.steps,
                step_m=self.step_m,
                step_deg=self.step_deg,
                options=parse_options(self.options),
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for planner in self.planners
        ]


def check_names(planners: Sequence[str], scenes: Sequence[str]) -> None:
    """Refuse unknown planners and scenes, and mesh files that cannot be read.

    Raises:
        InputError: naming the valid choices, or what is wrong with the file.
    """
    for kind, names in (("planner", planners), ("scene", scenes)):
        if not names:
            raise InputError(f"no {kind} given")
        if len(set(names)) < len(names):
            raise InputError(f"a {kind} is given twice: {', '.join(names)}")
    for planner in planners:
        check_planner(planner)
    for scene in scenes:
        if scene in SCENES:
            continue
        check_name(scene)
        load_soup(Path(scene))


def seed_list(split: str, count: int) -> list[int]:
    """The first ``count`` seeds of a split.

    Raises:
        InputError: an unknown split, or more seeds than it has.
    """
    if split not in SEED_SPLITS:
        raise unknown("split of seeds", split, SEED_SPLITS)
    seeds = SEED_SPLITS[split]
    if not 1 <= count <= len(seeds):
        raise InputError(f"episodes = {count} is outside [1, {len(seeds)}] of split {split}")
    return list(seeds[:count])


def run_planner_benchmark(
    config: PlannerBenchmark, out: Path, workers: int | None = None
) -> tuple[str, list[str]]:
    """Run what is missing, then write ``results.json``, ``table.md`` and the figures to ``out``.

    Returns:
        the Markdown table and the errors of failed episodes.

    Raises:
        InputError: what no episode could start with.
        RuntimeError: every episode failed; the files of an earlier run are left as they are.
    """
    check_episodes(config.specs())
    rows = run_all(config.specs(), run_episode, out, workers)
    check_any_finished(rows)
    return write_report(config, rows, out), failures(rows)


def write_report(config: PlannerBenchmark, rows: Sequence[Row], out: Path) -> str:
    """Write everything that is made from the rows; return the Markdown table."""
    from ms_slam_env.benchmark.figures import save_planner_figures

    made_by = provenance()
    aggregates = planner_report.aggregate(rows)
    summary = planner_report.summarise(rows)
    commits = sorted({row["commit"] for row in rows if row["commit"]})
    content: dict[str, Any] = {
        "provenance": made_by,
        "config": asdict(config),
        "seeds": seed_list(config.seeds, config.episodes),
        "summary": {
            planner: {metric: asdict(value) for metric, value in metrics.items()}
            for planner, metrics in summary.items()
        },
        "aggregates": aggregates,
        "episodes": list(rows),
    }
    write_json(out / "results.json", content)
    parts = [
        f"Medians with 95 % bootstrap intervals over episodes of {config.steps} steps of "
        f"{100 * config.step_m:g} cm / {config.step_deg:g} deg; best F-score first.\n\n",
        planner_report.planner_table(rows),
    ]
    if aggregates is None:
        print(
            "interquartile means left out: pip install 'ms-slam-env[statistics]'", file=sys.stderr
        )
    else:
        parts.append("\n### Across scenes\n\n" + planner_report.aggregate_table(aggregates))
    parts.append(
        f"\nMade by `{made_by['command']}`, version {made_by['versions']['ms-slam-env']}"
        f"{''.join(f', commit {commit}' for commit in commits)}, on {made_by['cpu']}.\n"
    )
    table = "".join(parts)
    (out / "table.md").write_text(table)
    save_planner_figures(rows, out)
    return table
