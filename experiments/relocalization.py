"""Does the SLAM find its pose again after a kidnapping, and never a wrong one?"""

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
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import median_interval
from ms_slam_env.report.tables import Table, Value, finished, format_value, make_table, summary
from ms_slam_env.scenes import PUBLISHED_ROOMS, Scene
from ms_slam_env.slam import SlamBackend

DEPTH_LIMIT_M = 3.0  # readings beyond count neither as mapped nor as not
FOUND_M, FOUND_DEG = 0.05, 5.0
WRONG_M, WRONG_DEG = 0.10, 10.0
_CLEARANCE_M = 0.1
_AWAY_M, _AWAY_DEG = 0.3, 30.0  # a kidnapping ends at least so far from where it began
_DRAWS = 300
_VIEW = xtion("80x60").scaled(0.5)  # of the images by which mapped space is known
_EVERY = 4  # mapped frames that are looked at
_SAME_M = 0.05  # a point this close to the surface that a mapped frame saw was seen


@dataclass(frozen=True)
class Setting:
    """A kind of interruption.

    Attributes:
        offset_m: the camera reappears up to so far from a random earlier pose
        offset_deg: and turned by up to so much.
        mapped: least share of the view's readings there that the map holds.
        black: fewest and most black frames in between; while they last the camera goes back along
            its path, else it jumps to anywhere on it.
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
"""One more kind: the camera reappears in another scene, and nothing there may be recognised."""
ALL_SETTINGS = (*SETTINGS, FOREIGN)


@dataclass(frozen=True)
class Interruption:
    """One interruption.

    Attributes:
        black: number of black frames before the camera sees again.
        poses: (N, 4, 4) true poses from then on.
        source: index of the mapped pose that the first of them is near; -1 for none.
        mapped: share of the first view's readings that lie in mapped space.
    """

    black: int
    poses: Float64
    source: int
    mapped: float


def map_path(scene: Scene, frames: int, seed: int) -> Float64:
    """Poses (frames, 4, 4) of the stretch that is mapped."""
    return sequences.handheld_trajectory(scene, frames, seed)


class MappedSpace:
    """What a camera has seen from the poses of a path."""

    def __init__(self, scene: Scene, path: Float64, intrinsics: Intrinsics = _VIEW) -> None:
        """Look from every few poses of ``path`` (N, 4, 4)."""
        self._sensor = sensor.RGBDSensor(scene, intrinsics, noise="none")
        self._intrinsics = intrinsics
        some = path[::_EVERY]
        self._world_to_camera = [invert(pose) for pose in some]
        self._depths = [self._sensor.ground_truth(pose).depth for pose in some]

    def share(self, T_world_camera: Float64) -> float:
        """Share of the readings from a pose (4, 4) that the path has seen.

        0 where less than half of the pixels have a reading in the range of the map.
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
            # One pixel is centimetres of a slanted surface.
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
    """Draw one interruption at the end of ``path`` (M, 4, 4) with ``after`` frames behind it.

    None if no pose was found that satisfies the setting.
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
    """The camera reappears on a path of its own in scene ``other``."""
    return Interruption(0, sequences.handheld_trajectory(other, after, seed), -1, 0.0)


def _random_motion(setting: Setting, rng: np.random.Generator) -> Float64:
    """A motion (4, 4) of uniform size up to the setting's in a uniform direction."""
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
    """Put a SLAM that has mapped a path through an interruption.

    Args:
        backend: the SLAM.
        one: the interruption.
        frames: N, taken after it.
        expected: (N, 4, 4) their poses in the map; None if they show nothing that it holds.

    Returns:
        ``found``: a pose within 5 cm and 5 degrees of the expected one was given; ``wrong``: one
        farther than 10 cm or 10 degrees off was, or any where none is expected; the others as the
        registry defines them.
    """
    height, width = frames[0].depth.shape
    nothing = RGBDFrame(
        np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    )
    dark = run_sequence(backend, [nothing] * one.black, reset=False)
    run = run_sequence(backend, frames, reset=False)
    tracked = run.anchored  # in a submap of its own the camera is not found yet
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
_OTHER_SEED = 500  # added to a scene's seed for the scene that nothing is known of


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

    The camera maps a stretch of a path, then finds itself elsewhere, with or without black frames
    in between, and moves on. Near, far and black lie in mapped space; foreign is another scene,
    where any pose is wrong.
    """

    scenes: tuple[str, ...] = PUBLISHED_ROOMS
    """Names of scenes; the maps take them in turns."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    settings: tuple[str, ...] = ALL_SETTINGS
    """Kinds of interruption."""
    variants: tuple[str, ...] = ("ferns", "local")
    """Variants of the relocalisation."""
    maps: int = bounded(25, 1, 100)
    """Maps, each of its own seed."""
    jumps: int = bounded(4, 1, 1000)
    """Interruptions of each kind after each map."""
    map_frames: int = bounded(200, 50, 100_000)
    """Length of the stretch that is mapped."""
    after: int = bounded(30, 2, 100_000)
    """Frames after an interruption; in those the pose must be found."""
    seeds: str = "validation"
    """Split that the seeds come from; a default read from them may not use the test seeds."""

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
        """Map a path with every variant and interrupt it; the maps and all attempts."""
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
            backend = slam.make("surfel", intrinsics, relocalisation=variant)
            mapping = run_sequence(backend, mapped, start=path[0])
            maps.append({"variant": variant, **_figures(mapping, path)})
            if mapping.lost_frames:
                continue  # what its poses are worth is unknown
            state = backend.get_state()
            for (name, one), frames in zip(interruptions, recordings, strict=True):
                backend.set_state(state)
                expected = None
                if name != FOREIGN:
                    # Where the map has drifted, it is there that the camera must be found.
                    drift = mapping.estimates[one.source] @ invert(path[one.source])
                    expected = drift @ one.poses
                outcome = interrupt(backend, one, frames, expected)
                attempts.append({"variant": variant, "setting": name, **outcome})
        return {"maps": maps, "attempts": attempts}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line for each image size, setting and variant, and all settings together."""
        cells: dict[tuple[str, str, str], list[Row]] = {}
        together: dict[tuple[str, str, str], list[Row]] = {}
        for row in finished(rows):
            for attempt in row["result"]["attempts"]:
                size, variant = row["spec"]["size"], attempt["variant"]
                cells.setdefault((size, attempt["setting"], variant), []).append(attempt)
                together.setdefault((size, EVERY, variant), []).append(attempt)
        if len({setting for _, setting, _ in cells}) > 1:
            cells |= together
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


def _line(key: tuple[str, str, str], attempts: list[Row]) -> dict[str, Value]:
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
    """How good the maps were, and how many were not used because a frame of theirs was lost."""
    maps = [figures for row in finished(rows) for figures in row["result"]["maps"]]
    used = [figures for figures in maps if not figures["lost_frames"]]
    ate = median_interval([figures["ate_unaligned_m"] for figures in used])
    return (
        f"{len(used)} of {len(maps)} maps were used, the others had lost a frame; median ATE "
        f"(unaligned) of the used ones {format_value(ate, 'ate_unaligned_m')} mm."
    )


class _Recorder:
    """Takes frames in a scene, each with noise of its own."""

    def __init__(self, scene: Scene, intrinsics: Intrinsics, seed: int) -> None:
        self._sensor = sensor.RGBDSensor(scene, intrinsics, seed=seed)
        self._taken = 0

    def record(self, poses: Float64) -> list[RGBDFrame]:
        first = self._taken
        self._taken += len(poses)
        return [self._sensor.capture(pose, first + index) for index, pose in enumerate(poses)]


def _draw(spec: RelocalizationSpec, scene: Scene, path: Float64) -> list[tuple[str, Interruption]]:
    """All interruptions within the scene; fewer where no pose there satisfies a setting."""
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
