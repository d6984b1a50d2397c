"""``ms-slam benchmark``: the experiment ``planners`` under the name that everybody looks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ms_slam_env.benchmark.planners import PlannerBenchmark
from ms_slam_env.cli.experiment import run


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; 1 if an episode failed.

    An interrupted run goes on from where it was when the same command is given again.
    """
    return run(PlannerBenchmark, arguments, "ms-slam benchmark", Path("results/benchmark"))
