"""``ms-slam compare``: the experiment ``compare`` as a command of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ms_slam_env.benchmark.compare import Compare
from ms_slam_env.cli.experiment import run


def main(arguments: Sequence[str]) -> int:
    """Run the comparison; 1 if a run failed.

    Repeat the same command to resume an interrupted comparison.
    """
    return run(Compare, arguments, "ms-slam compare", Path("results/compare"))
