"""SLAM backends side by side: error, time, memory and map on the same sequences."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ms_slam_env import slam
from ms_slam_env.benchmark.compare_report import save_figure, summarise, tables
from ms_slam_env.benchmark.compare_run import CompareSpec, run_apart
from ms_slam_env.camera import XTION_SIZES
from ms_slam_env.config import check_range, parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.scenes import ROOMS
from ms_slam_env.sequences import check_sequence

DEFAULT_SEQUENCES = (
    "living_room:2000:none",
    *(f"{scene}:2000" for scene in ROOMS),
    *(
        f"living_room:2000:kinect+{name}"
        for name in (
            "rolling-shutter",
            "misregistration",
            "auto-exposure",
            "depth-dropout",
            "rolling-shutter+misregistration+auto-exposure+depth-dropout+depth-quantisation",
        )
    ),
)
"""A clean and a noisy room, every scene, and what recordings suffer from, alone and together."""


@dataclass(frozen=True)
class Comparison:
    """What is compared.

    Attributes:
        sequences: folders, or ``scene:seed[:noise[+perturbation ...]]``.
        backends: ``NAME`` or ``NAME,parameter=value,...``.
        image_sizes: such as 160x120.
        frames: of a rendered sequence.
        speed_m_s: mean speed of the camera of a rendered sequence, where it does not turn.
        turn_deg_s: mean speed of rotation, where it turns.
        threads: cores that a backend may use.
        repeats: runs of each; the table shows the median time.

    Raises:
        InputError: an unknown sequence, scene, backend or size, or a number out of range.
    """

    sequences: tuple[str, ...] = DEFAULT_SEQUENCES
    backends: tuple[str, ...] = tuple(slam.BACKENDS)
    image_sizes: tuple[str, ...] = ("160x120", "320x240")
    frames: int = 200
    speed_m_s: float = 0.5
    turn_deg_s: float = 30.0
    threads: int = 1
    repeats: int = 1

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        for name in ("sequences", "backends", "image_sizes"):
            if not getattr(self, name):
                raise InputError(f"Comparison.{name} is empty")
        for text in self.sequences:
            check_sequence(text)
        for text in self.backends:
            name, _ = parse_named(text, "backend")
            if name not in slam.BACKENDS:
                raise unknown("SLAM backend", name, slam.BACKENDS)
        for size in self.image_sizes:
            if size not in XTION_SIZES:
                raise unknown("image size", size, XTION_SIZES)
        check_range(self, "frames", 10, 100_000)
        check_range(self, "threads", 1, 1024)
        check_range(self, "repeats", 1, 1000)

    def specs(self) -> list[CompareSpec]:
        """Every run; those of one sequence and size are neighbours."""
        return [
            CompareSpec(
                sequence=sequence,
                backend=name,
                image_size=size,
                params=params,
                frames=self.frames,
                speed_m_s=self.speed_m_s,
                turn_deg_s=self.turn_deg_s,
                threads=self.threads,
                repeat=repeat,
            )
            for repeat in range(self.repeats)
            for sequence in self.sequences
            for size in self.image_sizes
            for name, params in (parse_named(text, "backend") for text in self.backends)
        ]


def run_comparison(
    config: Comparison, out: Path, workers: int | None = None
) -> tuple[str, list[str]]:
    """Run every backend on every sequence; write ``compare.json``, ``table.md``, ``compare.png``.

    Runs that an earlier call left in ``out`` are not repeated. A run that fails, because the
    backend's extra is not installed for example, has its reason in the table.

    Returns:
        the tables as Markdown, and what failed, one line each.

    Raises:
        RuntimeError: every run failed.
    """
    rows = run_all(config.specs(), run_apart, out, workers, "runs")
    check_any_finished(rows)
    summary = summarise(rows)
    content: dict[str, Any] = {
        "provenance": provenance(),
        "config": asdict(config),
        "summary": summary,
        "runs": rows,
    }
    write_json(out / "compare.json", content)
    text = tables(summary)
    (out / "table.md").write_text(text, encoding="utf-8")
    save_figure(summary, out / "compare.png")
    return text, failures(rows)
