"""Experiment (c): where M_I and M_D come from, as in Fig. 3 of Saeedi et al., ICRA 2017."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ms_slam_env import metrics, slam
from ms_slam_env.camera import xtion
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.experiments.harness.episode_scores import LOST_ERROR_M
from ms_slam_env.experiments.harness.episodes import check_names, seed_list
from ms_slam_env.experiments.harness.experiment import Experiment
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Grouping, Table, make_table
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import handheld_trajectory, render_sequence

DIVERGENCES = ("M_I", "M_D", "intensity_divergence_mean", "depth_divergence_mean")


@dataclass(frozen=True)
class SkippingSpec:
    """One sequence at one interval.

    Attributes:
        scene: a scene's name or a mesh file.
        seed: of the scene, the trajectory and the sensor noise.
        keep_every: every so many frames are kept; 1 keeps all.
        frames: length of the whole sequence.
        image_size: width x height.
    """

    scene: str
    seed: int
    keep_every: int
    frames: int
    image_size: str = "160x120"


@dataclass(frozen=True)
class FrameSkipping(Experiment):
    """Divergence against trajectory error when frames are skipped

    Hand-held sequences of which every n-th frame is kept, which makes the divergence between
    neighbours larger; SLAM runs on what is left. The targets M_I and M_D are read at the largest
    interval up to which the error stays small and no sequence is lost.
    """

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

    unit = rows_key = "sequences"

    def __post_init__(self) -> None:
        """Refuse intervals that leave no sequence."""
        for interval in self.intervals:
            if not 1 <= interval <= self.frames // 3:
                raise InputError(f"interval {interval} is outside [1, {self.frames // 3}]")
        if not self.desired_ate_m > 0:
            raise InputError(f"desired_ate_m = {self.desired_ate_m} must be > 0")

    def specs(self) -> list[SkippingSpec]:
        """Every sequence at every interval."""
        check_names(("random",), self.scenes)
        return [
            SkippingSpec(scene, seed, interval, self.frames)
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.sequences)
            for interval in self.intervals
        ]

    @staticmethod
    def run(spec: SkippingSpec) -> dict[str, Any]:
        """Render the kept frames, run SLAM on them, and measure divergence and error."""
        scene = get_scene(spec.scene, spec.seed)
        trajectory = handheld_trajectory(scene, spec.frames, spec.seed)[:: spec.keep_every]
        sequence = render_sequence(scene, trajectory, xtion(spec.image_size), seed=spec.seed)
        K = sequence.intrinsics
        divergences = consecutive_divergences(sequence.frames, K, [DivergenceConfig()])[:, 0]
        run = run_sequence(slam.make("surfel", K), sequence)
        worst = metrics.absolute_errors(run.estimates, sequence.poses, align="none").max()
        return {
            "frames": len(sequence),
            "ate_m": metrics.ate_rmse(run.estimates, sequence.poses),
            "lost": bool(worst > LOST_ERROR_M or run.lost_frames),
            "M_I": float(divergences[:, 0].max()),
            "M_D": float(divergences[:, 1].max()),
            "intensity_divergence_mean": float(divergences[:, 0].mean()),
            "depth_divergence_mean": float(divergences[:, 1].mean()),
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line an interval, and the targets."""
        note = "Medians (of losses: the share) over sequences with their 95 % intervals."
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
        return {
            "seeds": seed_list(self.seeds, self.sequences),
            "suggested_targets": suggest_targets(by_interval(rows).rows, self.desired_ate_m),
        }


def by_interval(rows: Sequence[Row], note: str = "") -> Table:
    """Medians with intervals and share of lost sequences, a line an interval."""
    grouping = Grouping(("keep_every",), (*DIVERGENCES, "ate_m", "lost"), rank_by="keep_every")
    return grouping.table(rows, note=note)


def suggest_targets(
    lines: Sequence[Mapping[str, Any]], desired_ate_m: float
) -> dict[str, float] | None:
    """Targets from the largest interval up to which SLAM copes.

    At this interval, and at every smaller one, the median ATE is at most ``desired_ate_m`` and
    no sequence is lost: a frame-to-frame SLAM error that stays small until tracking breaks makes
    the median blind to the sequences that broke. M_I and M_D are the medians over sequences of
    equations (11) and (12) at that interval; None if already the first interval fails.

    Args:
        lines: of :func:`by_interval`, in the order of the intervals.
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


def _every(interval: int) -> str:
    return "every frame" if interval == 1 else f"every {interval}"
