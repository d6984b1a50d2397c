"""Does the SLAM find its pose again after a kidnapping, and never a wrong one?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from ms_slam_experiments.shared.interruptions import (
    ALL_SETTINGS,
    FOREIGN,
    SETTINGS,
    Interruption,
    MappedSpace,
    draw_interruption,
    foreign_interruption,
    interrupt,
    map_path,
)

from ms_slam_env import scenes, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.run_sequence import SequenceRun, run_sequence
from ms_slam_env.geometry import invert
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.report.charts import Chart, Panel, interval_series
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import median_interval
from ms_slam_env.report.tables import Table, Value, finished, format_value, make_table, summary
from ms_slam_env.scenes import PUBLISHED_ROOMS, Scene
from ms_slam_env.scenes.registry import check_name
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.surfel.config import RELOCALISATIONS

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
        for scene in self.scenes:
            check_name(scene)
        check_each("scene", self.scenes, self.scenes)
        check_each("setting", self.settings, ALL_SETTINGS)
        check_each("variant", self.variants, RELOCALISATIONS)
        if self.after > self.map_frames:
            raise InputError(f"after = {self.after} is more than map_frames = {self.map_frames}")
        for size in self.sizes:
            xtion(size)
        seeds = seed_list(self.seeds, self.maps)
        return [
            self.spec(RelocalizationSpec, scene=scene, seed=seed, size=size)
            for size in self.sizes
            for scene, seed in zip(cycle(self.scenes), seeds, strict=False)
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
        self._sensor = RGBDSensor(scene, intrinsics, seed=seed)
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
        "ate_unaligned_m": ate_rmse(mapping.estimates, path, align="none"),
        "lost_frames": mapping.lost_frames,
        "cpu_ms_median": float(np.median(mapping.cpu_ms)),
    }
