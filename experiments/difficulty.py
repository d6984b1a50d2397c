"""Dataset difficulty: Table I of the paper, for recorded depth and for motions in our scenes.

Saeedi et al., ICRA 2017, section V-C: the harder a sequence, the larger its divergence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.shared.motion_difficulty import (
    CORRELATIONS,
    ORDERED,
    SEEN,
    STATISTICS,
    WHERE,
    judgements,
    statistics,
)

from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import XTION_SIZES
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.image_motion import MOTIONS, WatchedSequence, by_second, watch_frames
from ms_slam_env.evaluation.sequence_divergence import KINDS, statistics_of
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import rank_correlation
from ms_slam_env.report.tables import Column, Table, finished, make_table
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import Sequence as RGBDSequence
from ms_slam_env.sequences import icl_nuim, place_trajectory, render_sequence

HISTOGRAMS = {"paper": DivergenceConfig.paper(), "default": DivergenceConfig()}
PAPER = {
    "lr_kt0": (0.0250, 0.0026, 0.0014),
    "lr_kt1": (0.0183, 0.0026, 0.0012),
    "lr_kt2": (0.0427, 0.0032, 0.0023),
    "lr_kt3": (0.0352, 0.0032, 0.0023),
}
"""Table I of the paper: max, mean and "variance" of the intensity divergence."""
RECORDING = "recorded depth"
"""Scene of a row that was recorded, not rendered."""


@dataclass(frozen=True)
class DifficultySpec:
    """A motion in a scene, or a recording.

    Attributes:
        scene: name, mesh file, or ``RECORDING``.
        motion: such as ``lr_kt0``.
        motions: all that are placed together.
        data: folder of the trajectories and recordings.
        placement: seed of the place.
        scale: factor on all motions.
        image_size: of the rendered images; recorded ones are at most as large.
        noise: of the rendered images.
        every: take every n-th frame.
        first: take so many frames only; 0: all.
    """

    scene: str
    motion: str
    motions: tuple[str, ...]
    data: str
    placement: int
    scale: float
    image_size: str
    noise: str
    every: int
    first: int = 0


@dataclass(frozen=True)
class Difficulty(Checked, Experiment):
    """Difficulty of motions

    The divergence from frame to frame along the ICL-NUIM motions, beside the order that the paper
    found (kt2 and kt3 harder than kt0 and kt1): in lr_kt3's recorded depth, and in other scenes,
    where all four are placed as one rigid whole, at one scale, at several places, because what a
    camera sees differs from place to place.
    """

    data: Path | None = None
    """Folder that holds icl_nuim/trajectories/lr_kt0.tum.txt and so on, and lr_kt3_depth."""
    scenes: tuple[str, ...] = ("living_room",)
    """Names of scenes, or mesh files."""
    motions: tuple[str, ...] = ("lr_kt0", "lr_kt1", "lr_kt2", "lr_kt3")
    """Files of the trajectories, without .tum.txt."""
    placements: int = bounded(3, 1, 1000)
    """Places of the motions in each scene."""
    image_size: str = chosen("320x240", *XTION_SIZES)
    """Of the rendered images, with the field of view of ICL-NUIM's camera."""
    noise: tuple[str, ...] = ("none",)
    """Noise of the rendered images: none, kinect, or both."""
    every: int = bounded(1, 1, 1000)
    """Take every n-th frame."""

    unit = "motions"

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        super().__post_init__()
        for name in self.noise:
            noise_config(name)

    def specs(self) -> list[DifficultySpec]:
        """The recording, and every motion at every place; what was recorded also as far as that.

        The scale is the largest at which all motions together fit at every place of every scene.

        Raises:
            InputError: a scene, trajectory or recording that cannot be read, or no place.
        """
        if self.data is None:
            raise InputError("--data is missing: the folder that holds icl_nuim")
        data, size, every = str(self.data), self.image_size, self.every
        times, together = icl_nuim.read_motions(data, self.motions)
        scale = min(
            place_trajectory(get_scene(scene, 0), together, seed).scale
            for scene in self.scenes
            for seed in range(self.placements)
        )
        recorded = len(icl_nuim.recorded_depth(data, size, every))
        kinds = [(motion, 0) for motion in self.motions]
        if icl_nuim.RECORDED in self.motions:
            length = len(times[self.motions.index(icl_nuim.RECORDED)][::every])
            kinds += [(icl_nuim.RECORDED, recorded)] if length > recorded else []
        own = DifficultySpec(RECORDING, icl_nuim.RECORDED, (), data, 0, 1.0, size, "none", every)
        return [own] + [
            DifficultySpec(
                scene, motion, self.motions, data, seed, scale, size, noise, every, first
            )
            for noise in self.noise
            for scene in self.scenes
            for seed in range(self.placements)
            for motion, first in kinds
        ]

    @staticmethod
    def run(spec: DifficultySpec) -> dict[str, Any]:
        """Statistics of the divergence, how camera and image move, and what they see."""
        watched = watch(spec)
        lines, curves = [], []
        for (name, values), (column, kind) in product(
            watched.divergences.items(), enumerate(KINDS)
        ):
            own = values[:, column]
            if np.isnan(own).all():
                continue
            label = {"histograms": name, "divergence": kind}
            numbers = statistics_of(own, watched.gaps_s)
            lines.append({
                **label,
                **{f"divergence_{key}": value for key, value in numbers.items()},
                **{key: rank_correlation(own, moved)
                   for key, moved in zip(CORRELATIONS, watched.motion.values(), strict=True)},
            })  # fmt: skip
            seconds, rates = by_second(watched.times_s, own, watched.gaps_s)
            curves.append({**label, "since_start_s": seconds, "divergence_rate": rates})
        return {
            "frames": len(watched.times_s) + 1,
            **{name: float(np.mean(values)) for name, values in watched.motion.items()},
            "contrast": watched.contrast,
            "depth_m": watched.depth_m,
            "statistics": lines,
            "curves": curves,
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Statistics, motions, the paper's, the order, and what the divergence goes with."""
        lines = statistics(rows)
        which = ("scene", "noise", "motion")
        once = {tuple(map(line.get, which)): line for line in lines}
        names = ("max", "mean", "variance")
        paper: list[dict[str, Any]] = [
            {"motion": m, **dict(zip(names, of, strict=True))} for m, of in PAPER.items()
        ]
        judged = judgements(rows)
        ordered = [line for line in judged if "places" in line]
        by_motion = [Column(f"motions_{key}", key, f"{metric(key).heading}, by motion")
                     for key in CORRELATIONS]  # fmt: skip
        pairs = [f"{what}_{name}" for name in ORDERED for what in ("pairs", "places")]
        return [
            make_table((*which, *WHERE[2:], *STATISTICS, "frames", "places"), lines,
                       note="Means over the places."),
            make_table((*which, *MOTIONS, *SEEN), once.values(), "Motions"),
            make_table(
                ("motion", Column("max", "divergence_max"), Column("mean", "divergence_mean"),
                 Column("variance", "divergence_variance", '"variance"')),
                paper, "The paper's Table I", "Of intensity."),
            make_table((*WHERE, "places", *pairs), ordered, "Order"),
            make_table((*WHERE, *CORRELATIONS, *by_motion), judged,
                       "What divergence goes with",
                       "By frame: median over motions and places. By motion: of the motions' means "
                       "over all places."),
        ]  # fmt: skip

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Divergence over time at the first place, a chart for each scene and histogram."""
        found: dict[tuple[str, str, str], dict[str, list[Series]]] = {}
        for row in finished(rows):
            spec = row["spec"]
            if spec["first"] or spec["placement"]:
                continue
            for curve in row["result"]["curves"]:
                which = Path(spec["scene"]).stem, spec["noise"], curve["histograms"]
                line = curve["since_start_s"], curve["divergence_rate"]
                panels = found.setdefault(which, {})
                panels.setdefault(curve["divergence"], []).append(
                    Series(spec["motion"], *line, mode="lines")
                )
        return [
            Chart("_".join(which).replace(" ", "_"), "Divergence over time: " + ", ".join(which),
                  "Mean of each second, at one place.",
                  [Panel("since_start_s", "divergence_rate", series, title=kind)
                   for kind, series in kinds.items()])
            for which, kinds in found.items()
        ]  # fmt: skip


def watch(spec: DifficultySpec) -> WatchedSequence:
    """Render or read the frames, and measure each against the one before."""
    return watch_frames(_open(spec), HISTOGRAMS)


def _open(spec: DifficultySpec) -> RGBDSequence:
    """The recording, or the motion placed in its scene."""
    if spec.scene == RECORDING:
        return icl_nuim.recorded_motion(spec.data, spec.image_size, spec.every)
    all_times, together = icl_nuim.read_motions(spec.data, spec.motions)
    scene = get_scene(spec.scene, 0)
    placed = place_trajectory(scene, together, spec.placement, spec.scale).poses
    number = spec.motions.index(spec.motion)
    start = sum(len(times) for times in all_times[:number])
    picked = np.arange(len(all_times[number]))[:: spec.every][: spec.first or None]
    times, poses = all_times[number][picked], placed[start + picked]
    K = icl_nuim.INTRINSICS.scaled(XTION_SIZES[spec.image_size][0] / icl_nuim.INTRINSICS.width)
    return render_sequence(scene, poses, K, spec.noise, spec.placement, timestamps=times)
