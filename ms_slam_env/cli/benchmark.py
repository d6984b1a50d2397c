"""``ms-slam benchmark``: the experiment ``planners`` under its familiar name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ms_slam_env.benchmark.planners import PlannerBenchmark
from ms_slam_env.cli.experiment import run


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; 1 if an episode failed.

    Repeat the same command to resume an interrupted run.
    """
    return run(PlannerBenchmark, arguments, "ms-slam benchmark", Path("results/benchmark"))
