"""The paper's robot experiment: four settings, an arm, ten runs each; is the map consistent?

Saeedi et al., ICRA 2017, section VI-C and figure 9. Run as
``python -m ms_slam_env.benchmark.arm_experiment --help``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from ms_slam_env.benchmark import arm_experiment_report as report
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import check_range
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.duplicate_objects import JudgedMap, judge_map, labelled_view
from ms_slam_env.experiments.harness.episodes import (
    DEFAULT_PLANNERS,
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    LOST_ERROR_M,
    EpisodeSpec,
    check_episodes,
    check_names,
    make_env,
    measure_trajectory,
    parse_options,
    play,
    seed_list,
)
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.experiments.pictures.judged_map import save_map_picture
from ms_slam_env.metrics.consistency import ConsistencyRule
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json

PROGRAM = "python -m ms_slam_env.benchmark.arm_experiment"
SCENES = ("window", "table", "wall", "carpet")
MOST_VIEWS = 200  # of an episode's frames, evenly picked: the verdict costs some 3 s
FRAME_RATE_HZ = 30  # no motion is shorter than a frame of the fastest camera


@dataclass(frozen=True)
class RunSpec(EpisodeSpec):
    """One run; see :class:`.episode.EpisodeSpec`.

    Attributes:
        seconds: simulated time after which the run ends.
        rule: when its map has failed.
    """

    seconds: float = 60.0
    rule: ConsistencyRule = field(default_factory=ConsistencyRule)

    def __post_init__(self) -> None:
        """Refuse unknown choices and values out of range."""
        super().__post_init__()
        try:
            check_range(self, "seconds", 0.1, 3600)
        except InputError as error:
            raise InputError(str(error).replace("RunSpec.", "")) from None


@dataclass(frozen=True)
class Arguments:
    """The paper's robot experiment: does a planner's map show no object twice?"""

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = SCENES
    """Names of scenes, or mesh files."""
    episodes: int = 10
    """Runs for each scene and planner, each with a seed of its own."""
    seconds: float = 60.0
    """Simulated time of a run."""
    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
    env_id: str = "MSActiveSLAM-v0"
    """Environment; the default one has the arm."""
    embodiment: str | None = None
    """What carries the camera, where it is not the environment's own."""
    seeds: str = "test"
    """Split that the seeds come from."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in pose=kinematics."""
    rule: ConsistencyRule = field(default_factory=ConsistencyRule)
    """When an object counts as present twice."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/arm_experiment")
    """Folder of the results."""

    def specs(self) -> list[RunSpec]:
        """Every run; those of one scene and seed are neighbours and share its geometry."""
        options = parse_options(self.options)
        # A run goes on when tracking is lost, as the paper's did.
        options.setdefault("lost_patience", 1_000_000)
        if self.embodiment is not None:
            options["embodiment"] = self.embodiment
        return [
            RunSpec(
                planner=planner,
                scene=scene,
                seed=seed,
                env_id=self.env_id,
                steps=max(1, math.ceil(self.seconds * FRAME_RATE_HZ)),
                step_m=self.step_m,
                step_deg=self.step_deg,
                options=options,
                seconds=self.seconds,
                rule=self.rule,
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for planner in self.planners
        ]


def run(spec: RunSpec, pictures: Path | None = None) -> dict[str, Any]:
    """Play one run and judge its map.

    Args:
        spec: the run.
        pictures: folder for a picture of the judged map; None for no picture.

    Returns:
        what :func:`.episode.measure_trajectory` returns, with ``success`` (no object is there
        twice), ``success_tracked`` (and the camera not lost at the end), ``duplicated`` (name to
        share of points apart), ``worst_share`` (the greatest such share of any object, NaN if none
        was large enough to judge), ``lost`` (at any frame), ``lost_at_end``, ``lost_frames_share``,
        ``mapped_area_m2``, ``map_points``, ``objects`` (judged), ``frames``, ``steps``,
        ``time_s``, ``energy_j``, ``decision_ms``.
    """
    env = make_env(spec)
    try:
        world = cast(ActiveSlamEnv, env.unwrapped)
        planner = make_planner(spec.planner, world, spec.seed)
        played = play(env, planner, spec.seed, spec.seconds)
        judged = judge_episode(world, spec.rule)
        if pictures is not None and len(judged.points):
            _save_picture(world, judged, spec, pictures)
        return {
            **{name: played[name] for name in ("steps", "decision_ms", "time_s", "energy_j")},
            **measure_trajectory(world),
            **_outcome(world, judged),
        }
    finally:
        env.close()


def judge_episode(world: ActiveSlamEnv, rule: ConsistencyRule | None = None) -> JudgedMap:
    """Judge the map of the episode just played.

    The frames are rendered again without noise from their true poses, with the objects' labels.
    """
    frames = np.flatnonzero(world.episode.tracked & world.episode.processed)
    picked = frames[np.unique(np.linspace(0, len(frames) - 1, MOST_VIEWS).astype(int))]
    truth, estimate = world.episode.trajectory_truth, world.episode.trajectory_estimate
    views = [labelled_view(world.sensor, truth[k], estimate[k]) for k in picked]
    return judge_map(
        world.slam.surface_points(), world.slam.surface_colors(), views, world.sensor, rule
    )


def _outcome(world: ActiveSlamEnv, judged: JudgedMap) -> dict[str, Any]:
    consistency = judged.consistency
    lost = ~world.episode.tracked | (world.episode.pose_errors > LOST_ERROR_M)
    shares = [item.apart_share for item in consistency.objects]
    return {
        "success": consistency.success,
        "success_tracked": consistency.success and not lost[-1],
        "duplicated": {judged.name(item): item.apart_share for item in consistency.duplicated},
        "worst_share": max(shares, default=math.nan),
        "objects": len(shares),
        "lost": bool(lost.any()),
        "lost_at_end": bool(lost[-1]),
        "lost_frames_share": float(lost.mean()),
        "mapped_area_m2": world.coverage.mapped_area,
        "map_points": len(judged.points),
        "frames": len(world.episode.timestamps),
    }


def _save_picture(world: ActiveSlamEnv, judged: JudgedMap, spec: RunSpec, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    name = spec.planner.replace("/", "_").replace(":", "_")
    save_map_picture(
        judged,
        world.episode.trajectory_estimate[:, :3, 3],
        folder / f"{Path(spec.scene).stem}_{name}_{spec.seed}.png",
        f"{Path(spec.scene).stem}, {spec.planner}, seed {spec.seed}",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(args.planners, args.scenes)
    check_episodes(args.specs())
    rows = run_all(
        args.specs(), partial(run, pictures=args.out / "maps"), args.out, args.workers, "runs"
    )
    check_any_finished(rows)
    made_by = provenance()
    summary = report.summarise(rows)
    write_json(
        args.out / "results.json",
        {
            "provenance": made_by,
            "seeds": seed_list(args.seeds, args.episodes),
            "rule": asdict(args.rule),
            "summary": [
                {"scene": scene, "planner": planner, **report.as_plain(cell)}
                for (scene, planner), cell in summary.items()
            ],
            "comparison": report.compare(rows),
            "paper": report.PAPER,
            "runs": rows,
        },
    )
    table = report.as_text(rows, args.seconds, made_by)
    (args.out / "table.md").write_text(table)
    report.save_figure(summary, args.out / "arm_experiment.png")
    print(table)
    return report_failures(failures(rows), PROGRAM)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
