"""Experiment (c): where M_I and M_D come from, as in Fig. 3 of Saeedi et al., ICRA 2017.

Hand-held sequences are rendered once; frames are skipped at regular intervals, which makes the
frame-to-frame divergence larger; SLAM runs on what is left. Run as
``python -m ms_slam_env.benchmark.frame_skipping --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics, slam
from ms_slam_env.benchmark.figures import caption, new_figure, save
from ms_slam_env.benchmark.planner_report import Column, finished
from ms_slam_env.camera import intensity_image, xtion
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.divergence import DivergenceConfig, make_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.experiments.harness.episodes import LOST_ERROR_M, check_names, seed_list
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report import statistics
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, format_number, markdown_table
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import Sequence as FrameSequence
from ms_slam_env.sequences import handheld_trajectory, render_sequence

PROGRAM = "python -m ms_slam_env.benchmark.frame_skipping"
COLUMNS = (
    Column("M_I", "M_I"),
    Column("M_D", "M_D"),
    Column("mean_I", "mean intensity divergence"),
    Column("mean_D", "mean depth divergence"),
    Column("ate_m", "ATE [mm]", 1000),
)


@dataclass(frozen=True)
class SkippingSpec:
    """One sequence at one interval.

    Attributes:
        scene: a scene's name or a mesh file.
        seed: of the scene, the trajectory and the sensor noise.
        interval: every so many frames are kept; 1 keeps all.
        frames: length of the whole sequence.
        image_size: width x height.
    """

    scene: str
    seed: int
    interval: int
    frames: int
    image_size: str = "160x120"


@dataclass(frozen=True)
class Arguments:
    """Divergence against trajectory error when frames are skipped at regular intervals."""

    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    """Names of scenes, or mesh files."""
    intervals: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 8, 10, 12)
    """Every so many frames are kept."""
    frames: int = 240
    """Length of a whole sequence; hand-held, at most 1.5 cm and 1 degree a frame."""
    sequences: int = 4
    """Sequences for each scene."""
    seeds: str = "validation"
    """Split that the seeds come from; a default read from them may not use the test seeds."""
    desired_ate_m: float = 0.01
    """Trajectory error for which the targets M_I and M_D are read."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/frame_skipping")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse intervals that leave no sequence."""
        for interval in self.intervals:
            if not 1 <= interval <= self.frames // 3:
                raise InputError(f"interval {interval} is outside [1, {self.frames // 3}]")
        if not self.desired_ate_m > 0:
            raise InputError(f"desired_ate_m = {self.desired_ate_m} must be > 0")

    def specs(self) -> list[SkippingSpec]:
        """Every sequence at every interval."""
        return [
            SkippingSpec(scene, seed, interval, self.frames)
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.sequences)
            for interval in self.intervals
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(("random",), args.scenes)
    rows = run_all(args.specs(), run_sequence, args.out, args.workers, "sequences")
    check_any_finished(rows)
    summary = summarise(rows)
    targets = suggest_targets(summary, args.desired_ate_m)
    write_json(
        args.out / "results.json",
        {
            "provenance": provenance(),
            "seeds": seed_list(args.seeds, args.sequences),
            "summary": {
                interval: {name: asdict(value) for name, value in cell.items()}
                for interval, cell in summary.items()
            },
            "desired_ate_m": args.desired_ate_m,
            "suggested_targets": targets,
            "sequences": rows,
        },
    )
    table = as_table(summary) + "\n" + targets_text(targets, args.desired_ate_m)
    (args.out / "table.md").write_text(table)
    save_figure(rows, args.out / "frame_skipping.png")
    print(table)
    return report_failures(failures(rows), PROGRAM)


def run_sequence(spec: SkippingSpec) -> dict[str, Any]:
    """Render the kept frames, run SLAM on them, and measure divergence and error."""
    scene = get_scene(spec.scene, spec.seed)
    trajectory = handheld_trajectory(scene, spec.frames, spec.seed)[:: spec.interval]
    sequence = render_sequence(scene, trajectory, xtion(spec.image_size), seed=spec.seed)
    divergences = frame_divergences(sequence)
    backend = slam.make("surfel", sequence.intrinsics)
    backend.reset(sequence.poses[0])
    tracked = [backend.track(frame) for frame in sequence.frames]
    estimate = np.stack([result.T_world_camera for result in tracked])
    worst = metrics.absolute_errors(estimate, sequence.poses, align="none").max()
    return {
        "kept_frames": len(sequence),
        "ate_m": metrics.ate_rmse(estimate, sequence.poses),
        "lost": bool(worst > LOST_ERROR_M or not all(r.tracking_ok for r in tracked)),
        "M_I": float(divergences[:, 0].max()),
        "M_D": float(divergences[:, 1].max()),
        "mean_I": float(divergences[:, 0].mean()),
        "mean_D": float(divergences[:, 1].mean()),
    }


def frame_divergences(sequence: FrameSequence) -> np.ndarray:
    """Intensity and depth divergence (N - 1, 2) of each frame from the one before, nats."""
    measure = make_divergence(DivergenceConfig(), sequence.intrinsics)
    histograms = [
        measure.histograms(intensity_image(frame.color)[None].astype(np.float32), frame.depth[None])
        for frame in sequence.frames
    ]
    pairs = zip(histograms[1:], histograms, strict=False)
    return np.stack([measure.divergence(current, previous)[0] for current, previous in pairs])


def summarise(rows: Sequence[Row]) -> dict[int, dict[str, Interval]]:
    """Medians with intervals and share of lost sequences, by interval."""
    cells: dict[int, list[dict[str, Any]]] = {}
    for row in finished(rows):
        cells.setdefault(row["spec"]["interval"], []).append(row["result"])
    return {
        interval: {
            "lost": statistics.share_interval([r["lost"] for r in results]),
            **{
                column.metric: statistics.median_interval([r[column.metric] for r in results])
                for column in COLUMNS
            },
        }
        for interval, results in sorted(cells.items())
    }


def suggest_targets(
    summary: dict[int, dict[str, Interval]], desired_ate_m: float
) -> dict[str, float] | None:
    """Targets from the largest interval up to which SLAM copes.

    At this interval, and at every smaller one, the median ATE is at most ``desired_ate_m`` and
    no sequence is lost: a frame-to-frame SLAM error that stays small until tracking breaks makes
    the median blind to the sequences that broke. M_I and M_D are the medians over sequences of
    equations (11) and (12) at that interval; None if already the first interval fails.
    """
    best = None
    for interval, cell in summary.items():
        if cell["ate_m"].value > desired_ate_m or cell["lost"].value > 0:
            break
        best = interval
    if best is None:
        return None
    names = ("M_I", "M_D", "mean_I", "mean_D")
    return {"interval": best, **{name: summary[best][name].value for name in names}}


def targets_text(targets: dict[str, float] | None, desired_ate_m: float) -> str:
    """The suggestion in a sentence."""
    desired = f"For an ATE of {1000 * desired_ate_m:g} mm and no sequence lost"
    if targets is None:
        return f"{desired} no interval suffices.\n"
    M_I, M_D = format_number(targets["M_I"]), format_number(targets["M_D"])
    return f"{desired}: M_I = {M_I}, M_D = {M_D} (every {targets['interval']} frames).\n"


def as_table(summary: dict[int, dict[str, Interval]]) -> str:
    """Markdown table, one line an interval."""
    return markdown_table(
        ["every n-th frame", *(column.heading for column in COLUMNS), "lost [%]"],
        [
            [
                str(interval),
                *(format_interval(cell[c.metric], c.scale) for c in COLUMNS),
                format_interval(cell["lost"], 100),
            ]
            for interval, cell in summary.items()
        ],
    )


def save_figure(rows: Sequence[Row], path: Path) -> None:
    """Draw ATE against the maximum and mean of each divergence, a dot a sequence."""
    figure = new_figure(4)
    panels = figure.subplots(1, 4, sharey=True)
    done = finished(rows)
    intervals = [row["spec"]["interval"] for row in done]
    ate = [1000 * row["result"]["ate_m"] for row in done]
    for ax, column in zip(panels, COLUMNS, strict=False):
        x = [row["result"][column.metric] for row in done]
        dots = ax.scatter(x, ate, c=intervals, cmap="viridis", s=14, alpha=0.8)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel(f"{column.heading} [nats]")
        ax.grid(alpha=0.3)
    panels[0].set_ylabel("ATE [mm]")
    figure.colorbar(dots, ax=panels[-1], label="every n-th frame")
    caption(figure, "One dot a sequence.")
    save(figure, path)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
