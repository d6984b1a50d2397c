"""Run-time adaptation against fixed configurations, on sequences quiet and violent by turns.

Saeedi et al., ICRA 2017, section V-B. Run as ``python -m ms_slam_env.benchmark.adaptation --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, slam
from ms_slam_env.benchmark.adaptation_report import comparison, save_figures, summarise, tables
from ms_slam_env.benchmark.planner_report import finished
from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame, xtion
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import check_range
from ms_slam_env.evaluation.run_sequence import Step, run_sequence
from ms_slam_env.experiments.harness.episodes import check_names, seed_list
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.sequences import MotionSegments, open_sequence
from ms_slam_env.sequences.trajectory import PoseInterpolation
from ms_slam_env.slam.adaptation import (
    AdaptiveSlam,
    AgentConfig,
    DivergenceAdaptationConfig,
)
from ms_slam_env.slam.adaptation.controllers import DivergenceController
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.configuration import SlamConfiguration, write_configuration

PROGRAM = "python -m ms_slam_env.benchmark.adaptation"
ADAPTIVE = "adaptive"
ALSO = (
    SlamConfiguration(image_size="160x120", keep_every=3),
    SlamConfiguration(image_size="160x120"),
    SlamConfiguration(),
)
"""Fixed configurations that run too: what others may pick as the best one."""

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class AdaptationSpec:
    """One sequence, run by every competitor.

    Attributes:
        scene: a scene's name or a mesh file.
        seed: of the scene, the path and the sensor noise.
        stretches: how the camera is carried.
        image_size: of the camera, width x height.
        adaptation: what is compared with each of its configurations.
    """

    scene: str
    seed: int
    stretches: MotionSegments
    image_size: str
    adaptation: DivergenceAdaptationConfig


@dataclass(frozen=True)
class Arguments:
    """Adaptation by divergence against each of its configurations and the full image size."""

    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    """Names of scenes, or mesh files."""
    sequences: int = 4
    """Sequences for each scene."""
    seeds: str = "validation"
    """Split that the seeds come from."""
    image_size: str = "320x240"
    """Of the camera."""
    stretches: MotionSegments = field(default_factory=MotionSegments)
    """How the camera is carried."""
    configurations: tuple[Path, ...] = ()
    """YAML files, from fast to robust; none for the default three."""
    thresholds: tuple[float, ...] = DivergenceAdaptationConfig.thresholds
    """Of the change between frames, nats, one between any two configurations."""
    release_share: float = DivergenceAdaptationConfig.release_share
    """Of the thresholds, below which the way down is open."""
    dwell_frames: int = DivergenceAdaptationConfig.dwell_frames
    """Frames below before the way down is taken."""
    workers: int | None = 1
    """Parallel processes; None for one a core. Times are true with one on a quiet machine."""
    out: Path = Path("results/adaptation")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse what makes no experiment."""
        check_range(self, "sequences", 1, 1000)
        xtion(self.image_size)

    def adaptation(self) -> DivergenceAdaptationConfig:
        """What is to be judged."""
        return DivergenceAdaptationConfig(
            configurations=self.configurations or None,
            thresholds=self.thresholds,
            release_share=self.release_share,
            dwell_frames=self.dwell_frames,
        )

    def specs(self) -> list[AdaptationSpec]:
        """Every sequence."""
        adaptation = self.adaptation()
        return [
            AdaptationSpec(scene, seed, self.stretches, self.image_size, adaptation)
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.sequences)
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(("random",), args.scenes)
    rows = run_all(args.specs(), run_competitors, args.out, args.workers, "sequences")
    check_any_finished(rows)
    done = finished(rows)
    summary = summarise(done)
    for index, one in enumerate(args.adaptation().resolved(xtion(args.image_size))):
        write_configuration(args.out / f"configuration_{index}.yaml", one)
    write_json(
        args.out / "results.json",
        {
            "provenance": provenance(),
            "seeds": seed_list(args.seeds, args.sequences),
            "summary": summary,
            "comparison": comparison(done),
            "sequences": [_brief(row) for row in rows],
        },
    )
    text = tables(done)
    (args.out / "table.md").write_text(text)
    save_figures(done, args.out)
    print(text)
    return report_failures(failures(rows), PROGRAM)


def _brief(row: Row) -> Row:
    """A row without the traceback of a failure, which names folders; the error says enough."""
    return {key: value for key, value in row.items() if key != "traceback"}


def run_competitors(spec: AdaptationSpec) -> dict[str, Any]:
    """Render once; run every competitor on the same frames.

    Returns:
        ``runs``, by competitor: figures of ``judge``; ``violent``, per frame; and of the adaptive
        run per frame ``change`` (nats) and ``level``.
    """
    name = f"{spec.scene}:{spec.seed}"
    sequence = open_sequence(name, spec.image_size, path=spec.stretches)
    frames = list(sequence.frames)
    violent = spec.stretches.is_violent()
    runs = {}
    for name, backend in competitors(spec.adaptation, sequence.intrinsics).items():
        runs[name], levels, changes = judge(backend, frames, sequence.poses, violent)
    return {  # the adaptive one is last
        "runs": runs,
        "violent": violent.tolist(),
        "change": [round(change, 6) for change in changes],
        "level": levels,
        "thresholds": list(spec.adaptation.thresholds),
    }


def competitors(
    adaptation: DivergenceAdaptationConfig, intrinsics: Intrinsics
) -> dict[str, SlamBackend]:
    """Each configuration alone, the default ones with every frame, and the adaptation, last."""
    given = adaptation.resolved(intrinsics)
    also = [one for one in ALSO if _width(one) <= intrinsics.width]
    fixed = {describe(one): one for one in (*given, *also)}
    alone = {
        name: AgentConfig(configurations=(one, one), start=0).adapt(slam.make("surfel", intrinsics))
        for name, one in fixed.items()
    }
    # The same without the first change of configuration, which is from the default to the first.
    adaptive = replace(adaptation, configurations=given).adapt(slam.make("surfel", intrinsics))
    return {**alone, ADAPTIVE: adaptive}


def _width(configuration: SlamConfiguration) -> int:
    """Columns that frames are reduced to; 0 for as they come."""
    size = configuration.image_size
    return 0 if size is None else XTION_SIZES[size][0]


def describe(configuration: SlamConfiguration) -> str:
    """A configuration in a few words: image size, iterations and the like, share of frames."""
    parts = [configuration.image_size or "full size"]
    for key, value in configuration.slam_config.items():
        is_list = isinstance(value, (tuple, list))
        text = "-".join(map(str, value)) if is_list else str(value)
        parts.append(f"{text} {key.replace('_', ' ').replace(' per level', '')}")
    every = configuration.keep_every
    return ", ".join([*parts, "every frame" if every == 1 else f"one frame in {every}"])


def judge(
    backend: SlamBackend,
    frames: Sequence[RGBDFrame],
    truth: Float64,
    violent: NDArray[np.bool_],
) -> tuple[dict[str, float], list[int], list[float]]:
    """Run a SLAM over the frames.

    Returns:
        figures: ``cpu_ms``, mean processor time a frame, dropped ones and the adaptation's own work
        included; ``ate_m``, RMSE over all frames after SE(3) alignment, with the poses of dropped
        frames interpolated between processed ones; ``ate_online_m``, the same with the poses that
        were predicted for them; ``ate_max_m``; ``processed`` and ``lost``, shares of the frames;
        ``ext_violent_ms`` and ``ext_quiet_ms``. Then the level and the change of every frame.
    """
    levels: list[int] = []
    changes: list[float] = []

    def note(step: Step) -> None:
        assert isinstance(backend, AdaptiveSlam)
        levels.append(backend.level)
        controller = backend.controller
        changes.append(controller.change if isinstance(controller, DivergenceController) else 0.0)

    run = run_sequence(backend, frames, start=truth[0], on_step=note)
    online, processed, ms = run.estimates, run.processed, run.cpu_ms
    kept = np.flatnonzero(processed)
    filled = PoseInterpolation(kept.astype(np.float64), online[kept])(np.arange(len(frames)))
    ate = metrics.ate_statistics(filled, truth)
    figures = {
        "cpu_ms": float(ms.mean()),
        "ext_quiet_ms": float(ms[~violent].mean()),
        "ext_violent_ms": float(ms[violent].mean()) if violent.any() else float("nan"),
        "ate_m": ate.rmse,
        "ate_max_m": ate.max,
        "ate_online_m": metrics.ate_rmse(online, truth),
        "processed": float(processed.mean()),
        "lost": float(np.mean(~run.tracking_ok)),
    }
    return figures, levels, changes


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
