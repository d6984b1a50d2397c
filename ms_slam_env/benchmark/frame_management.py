"""Experiment: active frame management against regular skipping (ICRA 2017, section V-A).

Hand-held sequences with quiet and fast stretches are rendered; SLAM runs behind filters that drop
frames, and behind regular skipping of as many. Run as
``python -m ms_slam_env.benchmark.frame_management --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ms_slam_env import slam
from ms_slam_env.benchmark.frame_management_report import (
    flat_runs,
    save_figure,
    summarise,
    table,
)
from ms_slam_env.benchmark.frame_management_run import FilterSpec, run_filters
from ms_slam_env.camera import XTION_SIZES
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.sequences import check_sequence
from ms_slam_env.slam.frame_selection import parse_frame_selection

PROGRAM = "python -m ms_slam_env.benchmark.frame_management"


@dataclass(frozen=True)
class Arguments:
    """Error and map against the share of frames that SLAM processes."""

    sequences: tuple[str, ...] = (
        "living_room:2000",
        "corridor:2001",
        "table:2002",
        "carpet:2003",
        "window:2004",
        "living_room:2005",
        "corridor:2006",
        "table:2007",
    )
    """scene:seed (quiet, walking and fast segments), scene:seed:steady, or folders."""
    managements: tuple[str, ...] = (
        "none",
        *(f"regular,every={n}" for n in (2, 3, 4)),
        *(f"divergence,threshold={t}" for t in (0.005, 0.01, 0.02, 0.04)),
        *(f"budget,share={s}" for s in (0.5, 0.33, 0.25)),
    )
    """NAME,option=value,... as the option frame_management of an environment has them."""
    backend: str = "surfel"
    """SLAM backend."""
    image_size: str = "160x120"
    """Of the camera; recordings are reduced to it."""
    frames: int = 300
    """Of a rendered sequence, 30 a second."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/frame_management")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        for name in ("sequences", "managements"):
            if not getattr(self, name):
                raise InputError(f"{name} is empty")
        for text in self.sequences:
            check_sequence(text)
        for text in self.managements:
            if parse_frame_selection(text).uses_clock:
                raise InputError(f"{text!r} measures time: no two runs are alike")
        if self.backend not in slam.BACKENDS:
            raise unknown("SLAM backend", self.backend, slam.BACKENDS)
        if self.image_size not in XTION_SIZES:
            raise unknown("image size", self.image_size, XTION_SIZES)
        check_range(self, "frames", 30, 100_000)

    def specs(self) -> list[FilterSpec]:
        """One piece of work a sequence."""
        return [
            FilterSpec(sequence, self.managements, self.backend, self.image_size, self.frames)
            for sequence in self.sequences
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    rows = run_all(args.specs(), run_filters, args.out, args.workers, "sequences")
    check_any_finished(rows)
    runs = flat_runs(rows)
    summary = summarise(runs)
    config = {k: v for k, v in asdict(args).items() if k not in ("out", "workers")}
    content = {"provenance": provenance(), "config": config, "summary": summary, "runs": runs}
    write_json(args.out / "frame_management.json", content)
    text = table(summary)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    save_figure(runs, args.out / "frame_management.png")
    print(text)
    return report_failures(failures(rows), PROGRAM)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
