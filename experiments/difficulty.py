"""Dataset difficulty: Table I of the paper, for recorded depth and for motions in our scenes.

Saeedi et al., ICRA 2017, section V-C: the harder a sequence, the larger its divergence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.frame_skipping import LEAST_DEPTH_SHARE
from ms_slam_experiments.shared import icl_nuim

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame, intensity_image, xtion
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.sequence_divergence import KINDS, consecutive_divergences, statistics_of
from ms_slam_env.geometry import invert, relative_angle, transform_points
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.statistics import rank_correlation
from ms_slam_env.report.tables import Column, Row, Table, finished, flattened, grouped, make_table
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import Sequence as RGBDSequence
from ms_slam_env.sequences import place_trajectory, render_sequence

HISTOGRAMS = {"paper": DivergenceConfig.paper(), "default": DivergenceConfig()}
PAPER = {
    "lr_kt0": (0.0250, 0.0026, 0.0014),
    "lr_kt1": (0.0183, 0.0026, 0.0012),
    "lr_kt2": (0.0427, 0.0032, 0.0023),
    "lr_kt3": (0.0352, 0.0032, 0.0023),
}
"""Table I of the paper: max, mean and "variance" of the intensity divergence."""
_LOOK_EVERY = 10  # frames between those that are looked at
RECORDING = "recorded depth"
"""Scene name of a recorded row."""


@dataclass(frozen=True)
class DifficultySpec:
    """A motion in a scene, or a recording.

    Attributes:
        scene: name, mesh file, or ``RECORDING``.
        motion: name such as ``lr_kt0``.
        motions: all motions that are placed together.
        data: folder of the trajectories and recordings.
        placement: seed of the place.
        scale: factor on all motions.
        image_size: size of rendered images; recorded ones are at most as large.
        noise: noise of the rendered images.
        every: take every n-th frame.
        first: number of first frames to take; 0 for all.
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

    Measures the divergence between frames along the ICL-NUIM motions, and compares it with the
    paper's order (kt2 and kt3 harder than kt0 and kt1). It uses lr_kt3's recorded depth and other
    scenes, in which all four motions are placed together at one scale, at several places, because
    the view differs between places.
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
    """Size of the rendered images, with the field of view of ICL-NUIM's camera."""
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
        """The recording, and every motion at every place.

        A recorded motion appears once more, cut to the recording's length. The scale is the largest
        at which all motions together fit at the first places of every scene; places where the
        camera is blind are replaced by later ones.

        Raises:
            InputError: a scene, trajectory or recording that cannot be read, or no place where the
                motions fit and see something.
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
        seeing = {
            scene: _places_that_see(get_scene(scene, 0), together, scale, self.placements)
            for scene in self.scenes
        }
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
            for seed in seeing[scene]
            for motion, first in kinds
        ]

    @staticmethod
    def run(spec: DifficultySpec) -> dict[str, Any]:
        """Statistics of the divergence, the motion of camera and image, and the images."""
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
        """Statistics, motions, the paper's table, the order, and correlations of the divergence."""
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
        """Divergence over time at the first place, a chart per scene and histogram."""
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


def _places_that_see(scene: Scene, poses: Float64, scale: float, count: int) -> list[int]:
    """First ``count`` seeds of places where the motions are never blind; 20 places more are tried.

    Raises:
        InputError: too few.
    """
    found: list[int] = []
    for seed in range(count + 20):
        placed = place_trajectory(scene, poses, seed, scale).poses
        few = render_sequence(scene, placed[::_LOOK_EVERY], xtion("80x60"), "none", seed).frames
        if all(np.mean(frame.depth > 0) >= LEAST_DEPTH_SHARE for frame in few):
            found.append(seed)
        if len(found) == count:
            return found
    raise InputError(
        f"scene {scene.name}: the motions see something all the way at {len(found)} places of "
        f"{count + 20}, but {count} are asked for"
    )


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


Line = dict[str, Any]

HARD, EASY = ("lr_kt2", "lr_kt3"), ("lr_kt0", "lr_kt1")
"""Order found by the paper: both motions of the first pair are harder than those of the second."""
STATISTICS = tuple(
    f"divergence_{name}"
    for name in ("max", "mean", "variance", "std", "max_per_s", "mean_per_s", "std_per_s")
)
ORDERED = ("max", "mean", "std")
SEEN = ("contrast", "depth_m")
CORRELATIONS = ("turn_correlation", "speed_correlation", "image_motion_correlation")
"""Correlations of the divergence with each of ``MOTIONS``."""
WHERE = ("scene", "noise", "histograms", "divergence")


def statistics(rows: Sequence[Row]) -> list[Line]:
    """Means over places, for every scene, motion, histogram and kind.

    A motion that was also recorded has a second line, over as many frames as the recording.
    """
    fields = (*WHERE, "motion")
    keys = (*STATISTICS, *MOTIONS, *SEEN)
    return [
        {
            **dict(zip(fields, group, strict=True)),
            **{key: float(np.mean([line[key] for line in lines])) for key in keys},
            "frames": lines[0]["frames"],
            "places": len(lines),
        }
        for group, lines in grouped(_lines(rows), fields).items()
    ]


def judgements(rows: Sequence[Row]) -> list[Line]:
    """Whether the paper's order holds, and correlations, for every scene, histogram and kind.

    ``pairs_max``, ``pairs_mean``, ``pairs_std``: number of pairs, out of four, in which the motion
    that the paper finds hard has a larger statistic than the easy one (means over the places);
    ``places_max`` and so on: number of places at which this holds for all four pairs.

    Spearman correlations of the divergence with the motion of camera and image: frame by frame
    within one motion at one place, median over motions and places; and ``motions_...``, of the
    motions' means over all places of a scene.
    """
    lines = _lines([row for row in rows if not row["spec"]["first"]])
    found = []
    for where in grouped(lines, WHERE):
        own = [line for line in lines if tuple(map(line["spec"].get, WHERE)) == where]
        by_motion = {motion: them for (motion,), them in grouped(own, ("motion",)).items()}
        known = set(HARD + EASY) <= set(by_motion)
        found.append({
            **dict(zip(WHERE, where, strict=True)),
            **(_order(by_motion) if known else {}),
            **_correlations(by_motion),
        })  # fmt: skip
    return found


def _order(by_motion: Mapping[str, Sequence[Mapping[str, Any]]]) -> Line:
    found: Line = {"places": min(map(len, by_motion.values()))}
    for name in ORDERED:
        values = {
            motion: np.array([line[f"divergence_{name}"] for line in by_motion[motion]])
            for motion in HARD + EASY
        }
        pairs = [(values[hard], values[easy]) for hard in HARD for easy in EASY]
        found[f"pairs_{name}"] = sum(int(h.mean() > e.mean()) for h, e in pairs)
        found[f"places_{name}"] = int(np.all([h > e for h, e in pairs], axis=0).sum())
    return found


def _correlations(by_motion: Mapping[str, Sequence[Mapping[str, Any]]]) -> Line:
    found: Line = {}
    for motion, key in zip(MOTIONS, CORRELATIONS, strict=True):
        single = [line[key] for lines in by_motion.values() for line in lines]
        found[key] = None if None in single else float(np.median(single))
        means = [
            [np.mean([line[name] for line in lines]) for name in ("divergence_mean", motion)]
            for lines in by_motion.values()
        ]
        if len(means) > 2:
            found[f"motions_{key}"] = rank_correlation(*np.array(means).T)
    return found


def _lines(rows: Sequence[Row]) -> list[Row]:
    """A row for each histogram and kind of each finished row, with the row's common values."""
    lines: list[Row] = []
    for row in finished(rows):
        spec, result = row["spec"], row["result"]
        cut = f", first {spec['first']} frames" if spec["first"] else ""
        named = {"scene": Path(spec["scene"]).stem, "motion": spec["motion"] + cut}
        shared = {key: result[key] for key in ("frames", *MOTIONS, *SEEN)}
        lines += [
            {
                "spec": {**line["spec"], **named},
                "result": {**shared, **line["result"]},
                "error": None,
            }
            for line in flattened([row], "statistics")
        ]
    return lines


MOTIONS = ("turn_deg_s", "speed_m_s", "image_motion_deg_s")
"""Columns of `frame_motion`."""

_PIXELS_ACROSS = 40  # columns of the grid of tracked points


@dataclass(frozen=True)
class WatchedSequence:
    """Measures between T + 1 consecutive frames.

    Attributes:
        times_s: (T,) times of the later frame of each pair, since the first frame.
        gaps_s: (T,) times between the frames of each pair.
        divergences: by name of the histograms, (T, 2) intensity and depth, nats.
        motion: by ``MOTIONS``, (T,).
        contrast: standard deviation of the grey values, mean over the frames.
        depth_m: mean depth, mean over the frames.
    """

    times_s: Float64
    gaps_s: Float64
    divergences: dict[str, Float64]
    motion: dict[str, Float64]
    contrast: float
    depth_m: float


def watch_frames(
    sequence: RGBDSequence, histograms: Mapping[str, DivergenceConfig]
) -> WatchedSequence:
    """Compare each frame with the one before, in one pass; without colour, intensity is NaN.

    Args:
        sequence: sequence with true poses.
        histograms: settings of the divergence by name.
    """
    times, poses, K = sequence.timestamps, sequence.poses, sequence.intrinsics
    motion, shades, depths = [], [], []

    def seen() -> Iterator[RGBDFrame]:
        for index, frame in enumerate(sequence.frames):
            shades.append(contrast(frame))
            depths.append(float(frame.depth[frame.depth > 0].mean()) if frame.depth.any() else 0.0)
            if index + 1 < len(poses):
                gap_s = float(times[index + 1] - times[index])
                motion.append(frame_motion(frame, poses[index], poses[index + 1], K, gap_s))
            yield frame

    values = consecutive_divergences(seen(), K, list(histograms.values()))
    if not sequence.has_color:
        values[..., 0] = np.nan
    return WatchedSequence(
        times[1:] - times[0],
        np.diff(times),
        {name: values[:, k] for k, name in enumerate(histograms)},
        dict(zip(MOTIONS, np.array(motion).T, strict=True)),
        float(np.mean(shades)),
        float(np.mean(depths)),
    )


def by_second(
    times_s: Float64, values: Float64, gaps_s: Float64
) -> tuple[list[float], list[float]]:
    """Middle of each second, and the rate in it: sum of the values over sum of the gaps.

    Args:
        times_s: (T,) times since the first frame.
        values: (T,) values between two frames.
        gaps_s: (T,) times between the two frames.
    """
    second = times_s.astype(int)
    filled = np.bincount(second) > 0
    rates = np.bincount(second, values)[filled] / np.bincount(second, gaps_s)[filled]
    return (np.flatnonzero(filled) + 0.5).tolist(), rates.tolist()


def frame_motion(
    frame: RGBDFrame, T_world_camera: Float64, T_world_next: Float64, K: Intrinsics, gap_s: float
) -> Float64:
    """Speeds of the camera and of its image from one frame to the next, (3,) as in ``MOTIONS``.

    ``turn_deg_s`` and ``speed_m_s`` are the camera's. ``image_motion_deg_s`` is the mean angle by
    which the surface points of the frame move in the camera's view, which depends on their
    distance; it is NaN without depth readings.

    Args:
        frame: frame with depth.
        T_world_camera: (4, 4) its pose.
        T_world_next: (4, 4) pose of the next frame.
        K: intrinsics of the frame.
        gap_s: seconds between the two.
    """
    T_next_camera = invert(T_world_next) @ T_world_camera
    turn_deg = np.degrees(relative_angle(np.eye(3), T_next_camera[:3, :3]))
    distance_m = np.linalg.norm(T_world_next[:3, 3] - T_world_camera[:3, 3])
    moved_deg = np.nan
    step = max(1, K.width // _PIXELS_ACROSS)
    depth = frame.depth[::step, ::step]
    rays = _rays(K, step)[depth > 0]
    if len(rays):
        points = transform_points(T_next_camera, rays * depth[depth > 0][:, None])
        moved_deg = np.degrees(_angles(rays, points).mean())
    return np.array([turn_deg, distance_m, moved_deg]) / gap_s


def contrast(frame: RGBDFrame) -> float:
    """Standard deviation of the frame's grey values, in grey levels."""
    return float(intensity_image(frame.color).std())


@lru_cache(maxsize=4)
def _rays(K: Intrinsics, step: int) -> Float64:
    return K.rays()[::step, ::step].copy()


def _angles(a: Float64, b: Float64) -> Float64:
    """Angles (N,) in radians between directions (N, 3)."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
