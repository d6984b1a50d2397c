"""``ms-slam compare``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from ms_slam_env.benchmark.compare import Comparison, run_comparison
from ms_slam_env.command_line import parse, report_failures


@dataclass(frozen=True)
class Arguments(Comparison):
    """Run SLAM backends over the same sequences: error, time, memory, map.

    Every run has a process of its own. An interrupted comparison goes on from where it was when the
    same command is given again.
    """

    workers: int = 1
    """Runs at the same time; more than one disturbs the time by the clock."""
    out: Path = Path("results/compare")
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Run the comparison; 1 if a run failed."""
    args = parse(Arguments, arguments, "ms-slam compare")
    config = Comparison(**{field.name: getattr(args, field.name) for field in fields(Comparison)})
    text, failed = run_comparison(config, args.out, args.workers)
    print(text)
    print(f"written: {args.out}/compare.json, table.md, compare.png", file=sys.stderr)
    return report_failures(failed)
