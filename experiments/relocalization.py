"""Does SLAM find its pose again after a kidnapping, and never a wrong one?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np

from ms_slam_env import metrics, scenes, sensor, sequences, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.loop_closures import pose_error
from ms_slam_env.evaluation.run_sequence import SequenceRun, run_sequence
from ms_slam_env.geometry import invert, make_pose, relative_angle, so3_exp, transform_points
from ms_slam_env.report.charts import Chart, Panel, interval_series
from ms_slam_env.report.statistics import median_interval
from ms_slam_env.report.tables import (
    Row,
    Table,
    Value,
    finished,
    flattened,
    format_value,
    grouped,
    make_table,
    summary,
)
from ms_slam_env.scenes import PUBLISHED_ROOMS, Scene
from ms_slam_env.slam import SlamBackend

DEPTH_LIMIT_M = 3.0  # readings beyond this are ignored
FOUND_M, FOUND_DEG = 0.05, 5.0
WRONG_M, WRONG_DEG = 0.10, 10.0
_CLEARANCE_M = 0.1
_AWAY_M, _AWAY_DEG = 0.3, 30.0  # a kidnapping ends at least this far from its start
_DRAWS = 300
_VIEW = xtion("80x60").scaled(0.5)  # camera of the images that define mapped space
_EVERY = 4  # stride in the mapped frames used for that
_SAME_M = 0.05  # a point this close to the surface in a mapped frame counts as seen


@dataclass(frozen=True)
class Setting:
    """A kind of interruption.

    Attributes:
        offset_m: largest distance of the new pose from a random earlier pose.
        offset_deg: largest rotation from it.
        mapped: least share of the new view's readings that the map holds.
        black: smallest and largest number of black frames in between, during which the camera goes
            back along its path; without black frames it jumps to any place on the path.
    """

    offset_m: float
    offset_deg: float
    mapped: float
    black: tuple[int, int] | None = None


SETTINGS: dict[str, Setting] = {
    "near": Setting(0.20, 15.0, 0.6),
    "far": Setting(0.40, 30.0, 0.5),
    "black": Setting(0.05, 4.0, 0.6, (5, 20)),
}
FOREIGN = "foreign"
"""Further kind: the camera reappears in another scene, where nothing may be recognised."""
ALL_SETTINGS = (*SETTINGS, FOREIGN)


@dataclass(frozen=True)
class Interruption:
    """One interruption.

    Attributes:
        black: number of black frames before the camera sees again.
        poses: (N, 4, 4) true poses from then on.
        source: index of the mapped pose close to the first of them; -1 if there is none.
        mapped: share of the first view's readings that lie in mapped space.
    """

    black: int
    poses: Float64
    source: int
    mapped: float


def map_path(scene: Scene, frames: int, seed: int) -> Float64:
    """Poses (frames, 4, 4) of the mapped stretch."""
    return sequences.handheld_trajectory(scene, frames, seed)


class MappedSpace:
    """Space that a camera has seen from the poses of a path."""

    def __init__(self, scene: Scene, path: Float64, intrinsics: Intrinsics = _VIEW) -> None:
        """Render views from every ``_EVERY``-th pose of ``path`` (N, 4, 4)."""
        self._sensor = sensor.RGBDSensor(scene, intrinsics, noise="none")
        self._intrinsics = intrinsics
        some = path[::_EVERY]
        self._world_to_camera = [invert(pose) for pose in some]
        self._depths = [self._sensor.ground_truth(pose).depth for pose in some]

    def share(self, T_world_camera: Float64) -> float:
        """Share of the readings at a pose (4, 4) that were seen from the path.

        0 if less than half of the pixels have a reading within the map's range.
        """
        view = self._sensor.ground_truth(T_world_camera)
        reading = (view.depth > 0) & (view.depth <= DEPTH_LIMIT_M)
        if reading.mean() < 0.5:
            return 0.0
        points = view.points[reading].astype(np.float64)
        seen = np.zeros(len(points), dtype=bool)
        height, width = self._intrinsics.shape
        for T_camera_world, depth in zip(self._world_to_camera, self._depths, strict=True):
            local = transform_points(T_camera_world, points)
            z = np.maximum(local[:, 2], 1e-6)
            u, v = np.rint(self._intrinsics.project(np.c_[local[:, :2], z])).T
            inside = (local[:, 2] > 0.05) & (local[:, 2] <= DEPTH_LIMIT_M)
            inside &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
            at = depth[v[inside].astype(int), u[inside].astype(int)]
            # A pixel covers centimetres on a slanted surface.
            near = np.abs(at - z[inside]) < _SAME_M * np.maximum(1.0, z[inside])
            seen[np.flatnonzero(inside)[near]] = True
        return float(seen.mean())


def draw_interruption(
    scene: Scene,
    path: Float64,
    space: MappedSpace,
    setting: Setting,
    after: int,
    rng: np.random.Generator,
) -> Interruption | None:
    """Draw an interruption at the end of ``path`` (M, 4, 4), followed by ``after`` frames.

    None if no pose satisfies the setting.
    """
    for _ in range(_DRAWS):
        offset = _random_motion(setting, rng)
        if setting.black is None:
            black, forwards = 0, rng.random() < 0.5
            source = int(rng.integers(0, len(path)))
        else:
            black, forwards = int(rng.integers(setting.black[0], setting.black[1] + 1)), False
            source = len(path) - 1 - black
        steps = source + np.arange(after) * (1 if forwards else -1)
        if steps.min() < 0 or steps.max() >= len(path):
            continue
        poses = path[steps] @ offset
        if scene.clearance(poses[:, :3, 3]).min() < _CLEARANCE_M:
            continue
        if setting.black is None and not _is_away(path[-1], poses[0]):
            continue
        share = space.share(poses[0])
        if share >= setting.mapped:
            return Interruption(black, poses, source, share)
    return None


def foreign_interruption(other: Scene, after: int, seed: int) -> Interruption:
    """An interruption after which the camera is on a new path in scene ``other``."""
    return Interruption(0, sequences.handheld_trajectory(other, after, seed), -1, 0.0)


def _random_motion(setting: Setting, rng: np.random.Generator) -> Float64:
    """A motion (4, 4) of uniformly drawn size, up to the setting's, in a random direction."""
    turn, step = rng.normal(size=3), rng.normal(size=3)
    turn *= np.radians(setting.offset_deg) * rng.random() / np.linalg.norm(turn)
    step *= setting.offset_m * rng.random() / np.linalg.norm(step)
    return make_pose(so3_exp(turn), step)


def _is_away(a: Float64, b: Float64) -> bool:
    moved = np.linalg.norm(a[:3, 3] - b[:3, 3]) >= _AWAY_M
    return bool(moved or relative_angle(a[:3, :3], b[:3, :3]) >= np.radians(_AWAY_DEG))


def interrupt(
    backend: SlamBackend, one: Interruption, frames: list[RGBDFrame], expected: Float64 | None
) -> dict[str, Any]:
    """Run a backend that has mapped a path through an interruption.

    Args:
        backend: the SLAM backend.
        one: the interruption.
        frames: N frames taken after it.
        expected: (N, 4, 4) their poses in the map; None if the map holds nothing they show.

    Returns:
        ``found``: a pose within 5 cm and 5 degrees of the expected one was given; ``wrong``: a pose
        more than 10 cm or 10 degrees off was given, or any pose if none is expected; the others
        as defined in the registry.
    """
    height, width = frames[0].depth.shape
    nothing = RGBDFrame(
        np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    )
    dark = run_sequence(backend, [nothing] * one.black, reset=False)
    run = run_sequence(backend, frames, reset=False)
    tracked = run.anchored  # in an unjoined submap, the camera does not count as found
    errors = []
    if expected is not None:
        errors = [pose_error(run.estimates[i], expected[i]) for i in np.flatnonzero(tracked)]
    seconds = np.arange(len(frames) + 1) / sensor.FRAME_RATE_HZ
    interrupted = [True] + [False] * len(frames)
    first = int(tracked.argmax()) if tracked.any() else None
    far = [m > WRONG_M or deg > WRONG_DEG for m, deg in errors]
    return {
        "found": any(m < FOUND_M and deg < FOUND_DEG for m, deg in errors),
        "wrong": any(far) or (expected is None and bool(tracked.any())),
        "frames_to_pose": math.inf if first is None else first,
        "relocalisation_s": float(
            metrics.relocalisation_times(seconds, interrupted, [False, *tracked.tolist()])[0]
        ),
        "first_error_m": errors[0][0] if errors else None,
        "first_error_deg": errors[0][1] if errors else None,
        "lost_frame_cpu_ms": float(np.mean(run.cpu_ms[: None if first is None else first + 1])),
        "black_frames": one.black,
        "black_tracked": len(dark) - dark.lost_frames,
        "mapped_share": one.mapped,
    }


EVERY = "all"
COLUMNS = (
    *("image_size", "setting", "variant", "attempts_count", "found", "wrong"),
    *("frames_to_pose", "relocalisation_s", "lost_frame_cpu_ms", "black_tracked"),
)
_OTHER_SEED = 500  # added to a scene's seed for the unknown scene


@dataclass(frozen=True)
class RelocalizationSpec:
    """One map and the interruptions after it; see :class:`Relocalization` for the fields."""

    scene: str
    seed: int
    size: str
    settings: tuple[str, ...]
    variants: tuple[str, ...]
    jumps: int
    map_frames: int
    after: int


@dataclass(frozen=True)
class Relocalization(Experiment, Checked):
    """Kidnapped cameras: how often, how soon and how truly SLAM finds its pose again

    The camera maps a stretch of a path, is then moved elsewhere, with or without black frames in
    between, and continues. Near, far and black end in mapped space; foreign ends in another scene,
    where any pose is wrong.
    """

    scenes: tuple[str, ...] = PUBLISHED_ROOMS
    """Names of scenes; successive maps alternate between them."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    settings: tuple[str, ...] = ALL_SETTINGS
    """Kinds of interruption."""
    variants: tuple[str, ...] = ("ferns", "local")
    """Variants of the relocalisation."""
    maps: int = bounded(25, 1, 100)
    """Number of maps, each with its own seed."""
    jumps: int = bounded(4, 1, 1000)
    """Interruptions of each kind after each map."""
    map_frames: int = bounded(200, 50, 100_000)
    """Length of the mapped stretch, in frames."""
    after: int = bounded(30, 2, 100_000)
    """Frames after an interruption, within which the pose must be found."""
    seeds: str = "validation"
    """Split that the seeds come from; do not derive defaults from test seeds."""

    unit = "maps"

    def specs(self) -> list[RelocalizationSpec]:
        """Every map."""
        from ms_slam_env.slam.surfel.surfel_config import RELOCALISATIONS

        check_each("scene", self.scenes, self.scenes)
        check_each("setting", self.settings, ALL_SETTINGS)
        check_each("variant", self.variants, RELOCALISATIONS)
        if self.after > self.map_frames:
            raise InputError(f"after = {self.after} is more than map_frames = {self.map_frames}")
        seeds = seed_list(self.seeds, self.maps)
        return [
            spec
            for size in self.sizes
            for scene, seed in zip(cycle(self.scenes), seeds, strict=False)
            for spec in self.each(RelocalizationSpec, size=(size,), scene=(scene,), seed=(seed,))
        ]

    @staticmethod
    def run(spec: RelocalizationSpec) -> dict[str, Any]:
        """Map a path with every variant and interrupt it; return the maps and all attempts."""
        scene = scenes.make(spec.scene, spec.seed)
        intrinsics = xtion(spec.size)
        path = map_path(scene, spec.map_frames, spec.seed)
        recorder = _Recorder(scene, intrinsics, spec.seed)
        mapped = recorder.record(path)
        interruptions = _draw(spec, scene, path)
        recordings = [recorder.record(one.poses) for _, one in interruptions]
        if FOREIGN in spec.settings:
            other = scenes.make(spec.scene, spec.seed + _OTHER_SEED)
            elsewhere = _Recorder(other, intrinsics, spec.seed)
            for jump in range(spec.jumps):
                one = foreign_interruption(other, spec.after, spec.seed + jump)
                interruptions.append((FOREIGN, one))
                recordings.append(elsewhere.record(one.poses))
        maps, attempts = [], []
        for variant in spec.variants:
            backend = slam.make("surfel", intrinsics, relocalisation=variant, submaps="off")
            mapping = run_sequence(backend, mapped, start=path[0])
            maps.append({"variant": variant, **_figures(mapping, path)})
            if mapping.lost_frames:
                continue  # its poses cannot be judged
            state = backend.get_state()
            for (name, one), frames in zip(interruptions, recordings, strict=True):
                backend.set_state(state)
                expected = None
                if name != FOREIGN:
                    # If the map has drifted, the camera must be found at the drifted pose.
                    drift = mapping.estimates[one.source] @ invert(path[one.source])
                    expected = drift @ one.poses
                outcome = interrupt(backend, one, frames, expected)
                attempts.append({"variant": variant, "setting": name, **outcome})
        return {"maps": maps, "attempts": attempts}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line for each image size, setting and variant, and all settings together."""
        attempts = flattened(rows, "attempts")
        cells = grouped(attempts, ("size", "setting", "variant"))
        if len({setting for _, setting, _ in cells}) > 1:
            together = grouped(attempts, ("size", "variant"))
            cells |= {(size, EVERY, variant): own for (size, variant), own in together.items()}
        sizes, settings = ([*dict.fromkeys(key[part] for key in cells)] for part in (0, 1))
        order = sorted(cells, key=lambda key: (sizes.index(key[0]), settings.index(key[1])))
        lines = [_line(key, cells[key]) for key in order]
        return [make_table(COLUMNS, lines, note=about_the_maps(rows))]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Share found by setting."""
        lines: Any = self.tables(rows)[0].rows
        series = []
        for name in dict.fromkeys((line["image_size"], line["variant"]) for line in lines):
            own = [line for line in lines if (line["image_size"], line["variant"]) == name]
            own = [line for line in own if not math.isnan(line["found"].value)]
            settings = [line["setting"] for line in own]
            found = [line["found"] for line in own]
            series.append(interval_series(", ".join(name), settings, found, "markers"))
        caption = "Mark: share of the attempts; bar: its 95 % interval."
        return [Chart("relocalization", "Poses found", caption, [Panel("", "found", series)])]


def _line(key: tuple[Any, ...], attempts: list[Row]) -> dict[str, Value]:
    findable = [attempt for attempt in attempts if attempt["setting"] != FOREIGN]
    given = [attempt for attempt in attempts if math.isfinite(attempt["relocalisation_s"])]
    seconds = [attempt["relocalisation_s"] for attempt in given]
    return {
        **dict(zip(("image_size", "setting", "variant"), key, strict=True)),
        "attempts_count": len(attempts),
        "found": summary(findable, "found"),
        "wrong": summary(attempts, "wrong"),
        "frames_to_pose": summary(given, "frames_to_pose"),
        "relocalisation_s": float(np.mean(seconds)) if seconds else None,
        "lost_frame_cpu_ms": summary(attempts, "lost_frame_cpu_ms"),
        "black_tracked": sum(attempt["black_tracked"] for attempt in attempts),
    }


def about_the_maps(rows: Sequence[Row]) -> str:
    """Quality of the maps, and number of maps not used because a frame was lost."""
    maps = [figures for row in finished(rows) for figures in row["result"]["maps"]]
    used = [figures for figures in maps if not figures["lost_frames"]]
    ate = median_interval([figures["ate_unaligned_m"] for figures in used])
    return (
        f"{len(used)} of {len(maps)} maps were used, the others had lost a frame; median ATE "
        f"(unaligned) of the used ones {format_value(ate, 'ate_unaligned_m')} mm."
    )


class _Recorder:
    """Takes frames in a scene, each with independent noise."""

    def __init__(self, scene: Scene, intrinsics: Intrinsics, seed: int) -> None:
        self._sensor = sensor.RGBDSensor(scene, intrinsics, seed=seed)
        self._taken = 0

    def record(self, poses: Float64) -> list[RGBDFrame]:
        first = self._taken
        self._taken += len(poses)
        return [self._sensor.capture(pose, first + index) for index, pose in enumerate(poses)]


def _draw(spec: RelocalizationSpec, scene: Scene, path: Float64) -> list[tuple[str, Interruption]]:
    """All interruptions within the scene; fewer if no pose satisfies a setting."""
    names = [name for name in SETTINGS if name in spec.settings]
    drawn: list[tuple[str, Interruption]] = []
    if not names:
        return drawn
    space = MappedSpace(scene, path)
    for name in names:
        rng = np.random.default_rng([spec.seed, list(SETTINGS).index(name)])
        for _ in range(spec.jumps):
            one = draw_interruption(scene, path, space, SETTINGS[name], spec.after, rng)
            drawn += [(name, one)] if one is not None else []
    return drawn


def _figures(mapping: SequenceRun, path: Float64) -> dict[str, Any]:
    return {
        "ate_unaligned_m": metrics.ate_rmse(mapping.estimates, path, align="none"),
        "lost_frames": mapping.lost_frames,
        "cpu_ms_median": float(np.median(mapping.cpu_ms)),
    }
