"""``ms-slam benchmark``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ms_slam_env.benchmark.episode import DEFAULT_STEP_DEG, DEFAULT_STEP_M
from ms_slam_env.benchmark.planner_benchmark import (
    DEFAULT_PLANNERS,
    DEFAULT_SCENES,
    PlannerBenchmark,
    run_planner_benchmark,
)
from ms_slam_env.command_line import parse, report_failures


@dataclass(frozen=True)
class Arguments:
    """Run planners on scenes with SLAM in the loop and compare them.

    An interrupted run goes on from where it was when the same command is given again.
    """

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = DEFAULT_SCENES
    """Names of scenes, or mesh files."""
    episodes: int = 10
    """Seeds for each scene."""
    steps: int = 100
    """Length of an episode."""
    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    """Environment."""
    seeds: str = "test"
    """Split that the seeds come from: train, validation or test."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in lookahead.reference=live targets.M_I=0.05."""
    workers: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(one a core)")] = None
    """Parallel processes, each of one thread."""
    out: Path = Path("results/benchmark")
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; 1 if an episode failed."""
    args = parse(Arguments, arguments, "ms-slam benchmark")
    config = PlannerBenchmark(
        planners=args.planners,
        scenes=args.scenes,
        episodes=args.episodes,
        steps=args.steps,
        step_m=args.step_m,
        step_deg=args.step_deg,
        env_id=args.env_id,
        seeds=args.seeds,
        options=args.options,
    )
    table, failed = run_planner_benchmark(config, args.out, args.workers)
    print(table)
    print(f"written: {args.out}/results.json, table.md and figures", file=sys.stderr)
    return report_failures(failed)
