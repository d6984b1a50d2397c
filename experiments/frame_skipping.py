"""Experiment (c): M_I and M_D from skipped frames, as in Fig. 3 of Saeedi et al., ICRA 2017."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.shared import icl_nuim
from numpy.typing import NDArray

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episode_scores import LOST_ERROR_M
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.run_sequence import run_backend
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.tables import Grouping, Row, Table, make_table
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory, place_trajectory, render_sequence

_FINEST = 12  # denominator of an interval: 1.333 is 4/3
HISTOGRAMS = {"default": DivergenceConfig(), "paper": DivergenceConfig.paper()}
DIVERGENCES = ("M_I", "M_D", "intensity_divergence_mean", "depth_divergence_mean")


@dataclass(frozen=True)
class SkippingSpec:
    """One sequence at one interval.

    Attributes:
        scene: a scene's name or a mesh file.
        seed: seed of the scene, the trajectory and the sensor noise.
        keep_every: keep one in this many frames; 1 keeps all, 1.5 drops one in three.
        frames: largest length of the whole sequence.
        image_size: width x height.
        motion: motion of ICL-NUIM placed in the scene, such as ``lr_kt1``; hand-held if empty.
        data: folder of the motion.
        histograms: ``default`` or ``paper``, settings of the divergence.
        backend: SLAM backend for the kept frames, with its parameters.
    """

    scene: str
    seed: int
    keep_every: float
    frames: int
    image_size: str = "160x120"
    motion: str = ""
    data: str = ""

    @property
    def kept(self) -> NDArray[np.int64]:
        """Indices of the kept frames: floor(k n) for k = 0, 1, 2, ..."""
        interval = Fraction(self.keep_every).limit_denominator(_FINEST)
        count = math.ceil(self.frames / interval)
        return np.array([math.floor(k * interval) for k in range(count)], dtype=np.int64)

    def trajectory(self) -> Float64:
        """Poses (N, 4, 4) of the kept frames."""
        scene = get_scene(self.scene, self.seed)
        if self.motion:
            poses = icl_nuim.read_motion(self.data, self.motion)[1]
            whole = place_trajectory(scene, poses, self.seed).poses
        else:
            whole = handheld_trajectory(scene, self.frames, self.seed)
        return whole[self.kept[self.kept < len(whole)]]

    histograms: str = "default"
    backend: str = "surfel"


@dataclass(frozen=True)
class FrameSkipping(Experiment):
    """Divergence against trajectory error when frames are skipped

    SLAM runs on every n-th frame, or on all but one in n, of hand-held sequences or of ICL-NUIM's
    motions. Skipping frames increases the divergence between neighbours. The targets M_I and M_D
    are read at the largest interval up to which the error stays small and no sequence is lost.
    """

    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    """Names of scenes, or mesh files."""
    intervals: tuple[float, ...] = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 30)
    """Keep one in this many frames; 1.5 drops one in three, 1.333 one in four."""
    frames: int = 240
    """Largest length of a sequence; hand-held ones move at most 1.5 cm and 1 degree a frame."""
    motions: tuple[str, ...] = ()
    """Motions of ICL-NUIM instead of hand-held ones, such as lr_kt1 lr_kt2."""
    data: Path | None = None
    """Folder with icl_nuim/trajectories/lr_kt1.tum.txt and so on."""
    sequences: int = 4
    """Sequences for each scene."""
    seeds: str = "validation"
    """Split that the seeds come from; do not derive defaults from test seeds."""
    desired_ate_m: float = 0.01
    """Trajectory error for which the targets M_I and M_D are read."""
    histograms: str = "default"
    """Settings of the divergence: default, or paper (256 bins, no smoothing, every pixel)."""
    backends: tuple[str, ...] = ("surfel",)
    """NAME, parameters appended as in surfel,check_slips=true; targets need a single backend."""

    unit = rows_key = "sequences"

    def __post_init__(self) -> None:
        """Refuse intervals that leave no sequence."""
        for interval in self.intervals:
            if not 1 <= interval <= self.frames // 3:
                raise InputError(f"interval {interval:g} is outside [1, {self.frames // 3}]")
        if not self.desired_ate_m > 0:
            raise InputError(f"desired_ate_m = {self.desired_ate_m} must be > 0")
        if self.histograms not in HISTOGRAMS:
            raise unknown("setting of histograms", self.histograms, HISTOGRAMS)

    def specs(self) -> list[SkippingSpec]:
        """Every sequence at every interval."""
        if self.motions and self.data is None:
            raise InputError("--motions needs --data, the folder that holds icl_nuim")
        for motion in self.motions:
            icl_nuim.read_motion(str(self.data), motion)  # refuses missing files
        return self.each(
            SkippingSpec,
            scene=self.scenes,
            seed=seed_list(self.seeds, self.sequences),
            motion=self.motions or ("",),
            keep_every=self.intervals,
            backend=self.backends,
            data=(str(self.data) if self.motions else "",),
        )

    @staticmethod
    def run(spec: SkippingSpec) -> dict[str, Any]:
        """Render the kept frames, run SLAM on them, and measure divergence and error."""
        scene = get_scene(spec.scene, spec.seed)
        camera = xtion(spec.image_size)
        sequence = render_sequence(scene, spec.trajectory(), camera, seed=spec.seed)
        K = sequence.intrinsics
        measure = HISTOGRAMS[spec.histograms]
        divergences = consecutive_divergences(sequence.frames, K, [measure])[:, 0]
        run = run_backend(spec.backend, sequence)
        worst = metrics.absolute_errors(run.estimates, sequence.poses, align="none").max()
        return {
            "frames": len(sequence),
            "ate_m": metrics.ate_rmse(run.estimates, sequence.poses),
            **metrics.tracked_errors(run.estimates, sequence.poses, run.tracking_ok),
            "lost": bool(worst > LOST_ERROR_M or run.lost_frames),
            "M_I": float(divergences[:, 0].max()),
            "M_D": float(divergences[:, 1].max()),
            "intensity_divergence_mean": float(divergences[:, 0].mean()),
            "depth_divergence_mean": float(divergences[:, 1].mean()),
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per interval, and the targets."""
        note = "Medians (of losses: the share) over sequences with their 95 % intervals."
        if self._compared:
            grouping = Grouping((*self._compared, "keep_every"), (*DIVERGENCES, "ate_m", "lost"))
            return [grouping.table(rows, note=note)]
        lines = by_interval(rows, note)
        targets = suggest_targets(lines.rows, self.desired_ate_m)
        wanted = f"For an ATE of {1000 * self.desired_ate_m:g} mm and no sequence lost"
        if targets is None:
            return [by_interval(rows, f"{note} {wanted} no interval suffices.")]
        return [lines, make_table(("keep_every", *DIVERGENCES), [targets], "Targets", f"{wanted}.")]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error against the largest and the mean divergence."""
        panels = [
            scatter(rows, key, "ate_m", "keep_every", "xy", label=_every) for key in DIVERGENCES
        ]
        return [Chart("frame_skipping", "Error against divergence", "One mark a sequence.", panels)]

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The seeds and the targets."""
        seeds = {"seeds": seed_list(self.seeds, self.sequences)}
        if self._compared:
            return seeds
        targets = suggest_targets(by_interval(rows).rows, self.desired_ate_m)
        return {**seeds, "suggested_targets": targets}

    @property
    def _compared(self) -> tuple[str, ...]:
        """Fields besides the interval that differ; targets are read only if there are none."""
        has = {"motion": self.motions, "backend": self.backends[1:]}
        return tuple(name for name, which in has.items() if which)


def by_interval(rows: Sequence[Row], note: str = "") -> Table:
    """Medians with intervals, and the share of lost sequences, one line per interval."""
    keys = (*DIVERGENCES, "ate_m", "ate_tracked_m", "tracked_share", "lost")
    grouping = Grouping(("keep_every",), keys, rank_by="keep_every")
    return grouping.table(rows, note=note)


def suggest_targets(
    lines: Sequence[Mapping[str, Any]], desired_ate_m: float
) -> dict[str, float] | None:
    """Targets from the largest interval up to which SLAM still works.

    At this interval, and at every smaller one, the median ATE is at most ``desired_ate_m`` and no
    sequence is lost. The second condition is needed because the error stays small until tracking
    breaks, so that the median does not show the sequences that broke. M_I and M_D are the medians
    over sequences of equations (11) and (12) at that interval; None if the first interval fails.

    Args:
        lines: result of :func:`by_interval`, in the order of the intervals.
        desired_ate_m: largest median ATE.
    """
    best: Mapping[str, Any] | None = None
    for line in lines:
        if line["ate_m"].value > desired_ate_m or line["lost"].value > 0:
            break
        best = line
    if best is None:
        return None
    return {"keep_every": best["keep_every"], **{key: best[key].value for key in DIVERGENCES}}


def _every(interval: float) -> str:
    return "every frame" if interval == 1 else f"every {interval:g}"
