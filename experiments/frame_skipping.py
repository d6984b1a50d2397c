"""Experiment (c): M_I and M_D from skipped frames, as in Fig. 3 of Saeedi et al., ICRA 2017."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
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
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.run_sequence import run_backend
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.sources import PARTS_OF_SEQUENCES
from ms_slam_env.report.statistics import pooled_rank_correlation
from ms_slam_env.report.tables import Grouping, Row, Table, grouped, make_table
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory, place_trajectory, render_sequence

LEAST_DEPTH_SHARE = 0.25
"""Places of a motion with a frame that has depth in fewer of its pixels are refused: the paper
assumes that "the sensor is not blind" (section III-A)."""
_LOOK_EVERY = 5  # frames between those that are looked at
_PLACEMENTS = 20  # places of a motion that are tried
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
        count: number of kept frames, from a start that the seed chooses; 0: all of ``frames``.
        placement: seed of the motion's place in the scene; the scene's if negative.
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
        count = self.count or math.ceil(self.frames / interval)
        return np.array([math.floor(k * interval) for k in range(count)], dtype=np.int64)

    def whole(self) -> Float64:
        """Poses (N, 4, 4) before frames are dropped."""
        scene = get_scene(self.scene, self.seed)
        if not self.motion:
            length = int(self.kept[-1]) + 1 if self.count else self.frames
            return handheld_trajectory(scene, length, self.seed)
        poses = icl_nuim.read_motion(self.data, self.motion)[1]
        seed = self.seed if self.placement < 0 else self.placement
        return place_trajectory(scene, poses, seed).poses

    def trajectory(self) -> Float64:
        """Poses (N, 4, 4) of the kept frames."""
        whole = self.whole()
        kept = self.kept
        if self.count:
            kept = kept + np.random.default_rng([self.seed, 83]).integers(len(whole) - kept[-1])
        return whole[kept[kept < len(whole)]]

    def is_blind(self) -> bool:
        """Whether some frame of the whole motion has depth in few of its pixels."""
        scene = get_scene(self.scene, self.seed)
        few = render_sequence(scene, self.whole()[::_LOOK_EVERY], xtion("80x60"), seed=self.seed)
        return any(np.mean(frame.depth > 0) < LEAST_DEPTH_SHARE for frame in few.frames)

    histograms: str = "default"
    backend: str = "surfel"
    count: int = 0
    placement: int = -1


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
    count: int = 0
    """Frames kept at every interval, so that the largest divergences of two intervals are of as
    many frames; 0: as many as the interval leaves of --frames."""
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
    parts = PARTS_OF_SEQUENCES

    def __post_init__(self) -> None:
        """Refuse intervals that leave no sequence."""
        for interval in self.intervals:
            if interval < 1 or (not self.count and interval > self.frames // 3):
                raise InputError(f"interval {interval:g} is outside [1, {self.frames // 3}]")
        if self.count < 0 or self.count in (1, 2):
            raise InputError(f"count = {self.count} must be 0 or at least 3")
        if not self.desired_ate_m > 0:
            raise InputError(f"desired_ate_m = {self.desired_ate_m} must be > 0")
        if self.histograms not in HISTOGRAMS:
            raise unknown("setting of histograms", self.histograms, HISTOGRAMS)

    def specs(self) -> list[SkippingSpec]:
        """Every sequence at every interval; motions where the camera always sees something.

        Raises:
            InputError: a motion without its file, shorter than ``count`` frames at an interval, or
                blind wherever it was placed.
        """
        if self.motions and self.data is None:
            raise InputError("--motions needs --data, the folder that holds icl_nuim")
        for motion in self.motions:
            length = len(icl_nuim.read_motion(str(self.data), motion)[1])
            longest = length / self.count if self.count else length
            if max(self.intervals) > longest:
                raise InputError(
                    f"{motion} has {length} frames, too few for {self.count} at every "
                    f"{max(self.intervals):g}-th"
                )
        specs = self.each(
            SkippingSpec,
            scene=self.scenes,
            seed=seed_list(self.seeds, self.sequences),
            motion=self.motions or ("",),
            keep_every=self.intervals,
            backend=self.backends,
            data=(str(self.data) if self.motions else "",),
        )
        return [_where_it_sees(spec) if spec.motion else spec for spec in specs]

    @staticmethod
    def run(spec: SkippingSpec) -> dict[str, Any]:
        """Render the kept frames, run SLAM on them, and measure divergence and error."""
        scene = get_scene(spec.scene, spec.seed)
        camera = xtion(spec.image_size)
        sequence = render_sequence(scene, spec.trajectory(), camera, seed=spec.seed)
        K = sequence.intrinsics
        measure = HISTOGRAMS[spec.histograms]
        shares: list[float] = []

        def seen() -> Iterator[RGBDFrame]:
            for frame in sequence.frames:
                shares.append(float(np.mean(frame.depth > 0)))
                yield frame

        divergences = consecutive_divergences(seen(), K, [measure])[:, 0]
        run = run_backend(spec.backend, sequence)
        worst = metrics.absolute_errors(run.estimates, sequence.poses, align="none").max()
        return {
            "frames": len(sequence),
            "smallest_depth_share": min(shares),
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
            keys = (*DIVERGENCES, "ate_m", "lost")
            grouping = Grouping((*self._compared, "keep_every"), keys, count="places")
            return [grouping.table(rows, note=note), correlations(rows)]
        lines = by_interval(rows, note)
        targets = suggest_targets(lines.rows, self.desired_ate_m)
        wanted = f"For an ATE of {1000 * self.desired_ate_m:g} mm and no sequence lost"
        if targets is None:
            return [by_interval(rows, f"{note} {wanted} no interval suffices."), correlations(rows)]
        aims = make_table(("keep_every", *DIVERGENCES), [targets], "Targets", f"{wanted}.")
        return [lines, aims, correlations(rows)]

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


@lru_cache(maxsize=1024)
def _place_that_sees(spec: SkippingSpec) -> int:
    """First seed of a place where the motion is never blind.

    Raises:
        InputError: it is blind at every place tried.
    """
    for k in range(_PLACEMENTS):
        placed = replace(spec, placement=spec.seed + 10_000 * k)
        if not placed.is_blind():
            return placed.placement
    raise InputError(
        f"{spec.motion} in {spec.scene}, seed {spec.seed}: at each of {_PLACEMENTS} places a frame "
        f"has depth in less than {100 * LEAST_DEPTH_SHARE:g} % of its pixels"
    )


def _where_it_sees(spec: SkippingSpec) -> SkippingSpec:
    of_place = replace(spec, keep_every=1.0, backend="", histograms="", count=0)
    return replace(spec, placement=_place_that_sees(of_place))


def correlations(rows: Sequence[Row]) -> Table:
    """Rank correlation of the error with each divergence, by motion, over places and intervals.

    The interval resamples places, since the runs of one place at several intervals see the same.
    """
    by: dict[tuple[str, str], list[list[Mapping[str, Any]]]] = {}
    for (backend, motion, *_), runs in grouped(
        rows, ("backend", "motion", "scene", "seed")
    ).items():
        by.setdefault((backend, motion), []).append(runs)
    lines: list[dict[str, Any]] = [
        {
            "backend": backend,
            "motion": motion or "hand-held",
            "divergence": metric(key).heading,
            "places": len(places),
            "correlation_ate": pooled_rank_correlation(
                [([r[key] for r in runs], [r["ate_m"] for r in runs]) for runs in places]
            ),
        }
        for (backend, motion), places in by.items()
        for key in DIVERGENCES
    ]
    columns = ("backend", "motion", "divergence", "places", "correlation_ate")
    note = "Over all places and intervals; 95 % intervals by resampling places."
    return make_table(columns, lines, "Rank correlation of divergence and error", note)


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
