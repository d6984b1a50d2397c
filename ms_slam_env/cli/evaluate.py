"""``ms-slam evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from ms_slam_env.benchmark.command_line import parse


@dataclass(frozen=True)
class Arguments:
    """Compare an estimated trajectory with the truth: ATE and RPE.

    Files are in the TUM format: timestamp tx ty tz qx qy qz qw, camera to world.
    """

    estimate: tyro.conf.Positional[Path]
    """Estimated trajectory."""
    groundtruth: tyro.conf.Positional[Path]
    """True trajectory."""
    align: str = "se3"
    """Alignment for ATE: se3, sim3 or none."""
    delta: int = 1
    """Frames between the poses of a relative error."""
    max_difference_s: float = 0.02
    """Largest difference between timestamps that correspond."""
    out: Path | None = None
    """Folder for evaluation.json."""


def main(arguments: Sequence[str]) -> int:
    """Print ATE and RPE."""
    args = parse(Arguments, arguments, "ms-slam evaluate")
    from ms_slam_env.benchmark.records import write_json
    from ms_slam_env.benchmark.trajectory_evaluation import evaluate_files

    result = evaluate_files(
        args.estimate, args.groundtruth, args.align, args.delta, args.max_difference_s
    )
    print(_text(result))
    if args.out is not None:
        write_json(args.out / "evaluation.json", result)
    return 0


def _text(result: dict[str, Any]) -> str:
    lines = [f"{result['poses']} poses, alignment {result['align']}, delta {result['delta']}"]
    for name, unit in (("ate_m", "m"), ("rpe_m", "m"), ("rpe_rad", "rad")):
        values = "  ".join(f"{key} {value:.6f}" for key, value in result[name].items())
        lines.append(f"{name.split('_')[0].upper()} [{unit}]  {values}")
    return "\n".join(lines)
