"""``ms-slam compare``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ms_slam_env import slam
from ms_slam_env.benchmark.command_line import parse, report_failures
from ms_slam_env.benchmark.compare import DEFAULT_SEQUENCES, Comparison, run_comparison


@dataclass(frozen=True)
class Arguments:
    """Run SLAM backends over the same sequences: error, time, memory, map.

    Every run has a process of its own. An interrupted comparison goes on from where it was when the
    same command is given again.
    """

    sequences: tuple[str, ...] = DEFAULT_SEQUENCES
    """Folders of recordings with truth, or scene:seed[:noise[+perturbation ...]] to be rendered."""
    backends: tuple[str, ...] = tuple(slam.BACKENDS)
    """Backends, parameters appended as in surfel,icp_rgb_weight=0.2."""
    image_sizes: tuple[str, ...] = ("160x120", "320x240")
    """Sizes of the images."""
    frames: int = 200
    """Length of a rendered sequence."""
    speed_m_s: float = 0.5
    """Mean speed of the camera of a rendered sequence where it does not turn, m/s at 30 Hz."""
    turn_deg_s: float = 30.0
    """Mean speed of rotation where it turns, degrees/s."""
    threads: int = 1
    """Cores that a backend may use."""
    repeats: int = 1
    """Runs of each; tables show the medians."""
    workers: int = 1
    """Runs at the same time; more than one disturbs the time by the clock."""
    out: Path = Path("results/compare")
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Run the comparison; 1 if a run failed."""
    args = parse(Arguments, arguments, "ms-slam compare")
    config = Comparison(
        sequences=args.sequences,
        backends=args.backends,
        image_sizes=args.image_sizes,
        frames=args.frames,
        speed_m_s=args.speed_m_s,
        turn_deg_s=args.turn_deg_s,
        threads=args.threads,
        repeats=args.repeats,
    )
    text, failed = run_comparison(config, args.out, args.workers)
    print(text)
    print(f"written: {args.out}/compare.json, table.md, compare.png", file=sys.stderr)
    return report_failures(failed)
