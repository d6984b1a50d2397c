"""Compare run-time adaptation with fixed configurations (Saeedi et al., ICRA 2017, V-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.evaluation.run_sequence import Step, run_sequence
from ms_slam_env.report.charts import Chart, Guide, Panel, Series
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import relative_cut
from ms_slam_env.report.tables import (
    Grouping,
    Table,
    finished,
    flattened,
    grouped,
    make_table,
    summary,
)
from ms_slam_env.sequences import MotionSegments, open_sequence
from ms_slam_env.sequences.trajectory import PoseInterpolation
from ms_slam_env.slam.adaptation import AdaptiveSlam, AgentConfig, DivergenceAdaptationConfig
from ms_slam_env.slam.adaptation.controllers import DivergenceController
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.slam.slam_backend import SlamBackend

ADAPTIVE = "adaptive"
ALSO = (
    SlamConfiguration(image_size="160x120", keep_every=3),
    SlamConfiguration(image_size="160x120"),
    SlamConfiguration(),
)
"""Further fixed configurations, which others might consider the best."""
METRICS = (
    *("cpu_ms_mean", "ate_interpolated_m", "ate_m", "ate_tracked_m", "tracked_share"),
    *("processed_share", "lost_share", "cpu_quiet_ms", "cpu_violent_ms"),
)
_SMALLEST_CHANGE = 1e-4  # nats; smaller changes are drawn here


@dataclass(frozen=True)
class AdaptationSpec:
    """One sequence, run by every competitor; see :class:`Adaptation` for the other fields.

    Attributes:
        seed: seed of the scene, the path and the sensor noise.
        adaptation: adaptation to compare with each of its configurations.
    """

    scene: str
    seed: int
    stretches: MotionSegments
    image_size: str
    adaptation: DivergenceAdaptationConfig


@dataclass(frozen=True)
class Adaptation(Experiment, Checked):
    """Adaptation by divergence against each of its configurations and the full image size

    Sequences alternate between calm and violent motion; all competitors get the same frames. Times
    are valid only with one worker on an idle machine.
    """

    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    """Names of scenes, or mesh files."""
    sequences: int = bounded(4, 1, 1000)
    """Sequences for each scene."""
    seeds: str = "validation"
    """Split that the seeds come from."""
    image_size: str = "320x240"
    """Image size of the camera."""
    stretches: MotionSegments = field(default_factory=MotionSegments)
    """How the camera moves."""
    configurations: tuple[Path, ...] = ()
    """YAML files, from fast to robust; by default three built-in ones."""
    levels: Path | None = None
    """File of levels written by ms-slam explore, instead of configurations and thresholds."""
    thresholds: tuple[float, ...] = DivergenceAdaptationConfig.thresholds
    """Thresholds of the change between frames, nats, one between neighbouring configurations."""
    release_share: float = DivergenceAdaptationConfig.release_share
    """Share of a threshold below which adaptation may return to the faster configuration."""
    dwell_frames: int = DivergenceAdaptationConfig.dwell_frames
    """Number of frames for which the change must stay below that share first."""

    unit = "sequences"
    workers = 1

    def adaptation(self) -> DivergenceAdaptationConfig:
        """The adaptation to evaluate."""
        names = ("levels", "thresholds", "release_share", "dwell_frames")
        own = {name: getattr(self, name) for name in names}
        return DivergenceAdaptationConfig(configurations=self.configurations or None, **own)

    def specs(self) -> list[AdaptationSpec]:
        """Every sequence."""
        xtion(self.image_size)
        seeds = seed_list(self.seeds, self.sequences)
        return self.each(
            AdaptationSpec, scene=self.scenes, seed=seeds, adaptation=(self.adaptation(),)
        )

    @staticmethod
    def run(spec: AdaptationSpec) -> dict[str, Any]:
        """Run every competitor, the adaptive one last, whose change and level are kept by frame."""
        sequence = open_sequence(f"{spec.scene}:{spec.seed}", spec.image_size, path=spec.stretches)
        frames = list(sequence.frames)
        violent = spec.stretches.is_violent()
        runs = []
        levels: list[int] = []
        changes: list[float] = []
        for name, backend in competitors(spec.adaptation, sequence.intrinsics).items():
            figures, levels, changes = judge(backend, frames, sequence.poses, violent)
            runs.append({"configuration": name, **figures})
        return {"runs": runs, "change": [round(x, 6) for x in changes], "level": levels}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Results of every competitor, then how much adaptation saves compared with each."""
        runs = flattened(rows, "runs")
        note = f"Medians of {len(finished(rows))} sequences with 95 % intervals."
        return [Grouping(("configuration",), METRICS).table(runs, note=note), comparison(runs)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error against time per frame, and the first sequence over time."""
        series = []
        for (name,), runs in grouped(flattened(rows, "runs"), ("configuration",)).items():
            ms, ate = ([run[key] for run in runs] for key in ("cpu_ms_mean", "ate_interpolated_m"))
            series.append(Series(name, ms, ate, mode="dots"))
            x, y = (summary(runs, key).value for key in ("cpu_ms_mean", "ate_interpolated_m"))
            series.append(Series(name, [x], [y], mode="markers"))
        against = Panel("cpu_ms_mean", "ate_interpolated_m", series, "y")
        caption = "Small dots: sequences; large marks: medians."
        charts = [Chart("error_time", "Error against time", caption, [against])]
        return charts + [_time_line(row) for row in finished(rows)[:1]]

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The configurations that adaptation switches among, from fast to robust."""
        resolved = self.adaptation().resolved(xtion(self.image_size))
        return {"configurations": [asdict(configuration) for configuration in resolved]}


def competitors(
    adaptation: DivergenceAdaptationConfig, intrinsics: Intrinsics
) -> dict[str, SlamBackend]:
    """Each configuration alone, the further fixed ones, and the adaptation, last."""
    given = adaptation.resolved(intrinsics)
    sizes = [XTION_SIZES[one.image_size] if one.image_size else (0, 0) for one in ALSO]
    also = [one for one, size in zip(ALSO, sizes, strict=True) if size[0] <= intrinsics.width]
    fixed = {str(one): one for one in (*given, *also)}
    alone = {
        name: AgentConfig(configurations=(one, one), start=0).adapt(slam.make("surfel", intrinsics))
        for name, one in fixed.items()
    }
    # The same, but without the initial change from the default to the first configuration.
    adaptive = replace(adaptation, configurations=given).adapt(slam.make("surfel", intrinsics))
    return {**alone, ADAPTIVE: adaptive}


def judge(
    backend: SlamBackend, frames: Sequence[RGBDFrame], truth: Float64, violent: NDArray[np.bool_]
) -> tuple[dict[str, float | None], list[int], list[float]]:
    """Run SLAM over N frames with true poses (N, 4, 4); ``violent`` (N,) marks fast motion.

    Returns:
        metrics; level and change of every frame.
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
        "cpu_ms_mean": float(ms.mean()),
        "cpu_quiet_ms": float(ms[~violent].mean()),
        "cpu_violent_ms": float(ms[violent].mean()) if violent.any() else float("nan"),
        "ate_interpolated_m": ate.rmse,
        "ate_interpolated_max_m": ate.max,
        "ate_m": metrics.ate_rmse(online, truth),
        **metrics.tracked_errors(online, truth, run.tracking_ok),
        "processed_share": float(processed.mean()),
        "lost_share": float(np.mean(~run.tracking_ok)),
    }
    return figures, levels, changes


def comparison(runs: Sequence[Row]) -> Table:
    """How much adaptation cuts each fixed configuration's median time and error, paired."""
    columns = ("configuration", "cpu_cut", "ate_cut", "better_share")
    by_name = {name: results for (name,), results in grouped(runs, ("configuration",)).items()}
    own = by_name.pop(ADAPTIVE, [])
    lines = []
    for name, other in by_name.items():
        (own_ms, other_ms), (own_ate, other_ate) = (
            [[run[key] for run in runs] for runs in (own, other)]
            for key in ("cpu_ms_mean", "ate_interpolated_m")
        )
        lines.append({
            "configuration": name,
            "cpu_cut": relative_cut(own_ms, other_ms),
            "ate_cut": relative_cut(own_ate, other_ate),
            "better_share": float(np.mean(np.less(own_ate, other_ate))),
        })  # fmt: skip
    note = "Of the ATE with dropped frames interpolated. A negative cut is a rise; better: lower."
    return make_table(columns, lines, "What adaptation cuts of each configuration", note)


def _time_line(row: Mapping[str, Any]) -> Chart:
    """Change between frames with its thresholds, and the active configuration."""
    spec, result = row["spec"], row["result"]
    violent = MotionSegments(**spec["stretches"]).is_violent()
    frames = list(range(len(violent)))
    change = np.maximum(result["change"], _SMALLEST_CHANGE).tolist()
    parts = {"quiet motion": ~violent, "violent motion": violent}

    def panel(key: str, values: Sequence[float], log: str, guides: Sequence[Guide]) -> Panel:
        shown = {name: [v if here else None for here, v in zip(part, values, strict=True)]
                 for name, part in parts.items()}  # fmt: skip
        series = [Series(name, frames, y, mode="lines") for name, y in shown.items()]
        return Panel("frame", key, series, log, guides)

    thresholds = [Guide(value) for value in spec["adaptation"]["thresholds"]]
    panels = [panel("change", change, "y", thresholds), panel("level", result["level"], "", ())]
    about = f"{spec['scene']}, seed {spec['seed']}: 0 is the fast configuration; dashed: thresholds"
    return Chart("time_line", "One sequence", about, panels)
