"""Does a lost camera continue in a submap that is joined at the right place and nowhere else?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from ms_slam_experiments.relocalization import FOREIGN, map_path

from ms_slam_env import metrics, scenes, slam
from ms_slam_env import sensor as sensors
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment, check_each, check_names
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.evaluation.loop_closures import pose_error
from ms_slam_env.evaluation.run_sequence import SequenceRun, run_sequence
from ms_slam_env.evaluation.submap_errors import submap_errors, submap_measures, submap_numbers
from ms_slam_env.geometry import invert, so3_exp
from ms_slam_env.report.charts import Chart, Panel, interval_series
from ms_slam_env.report.tables import Row, Table, Value, flattened, grouped, make_table, summary
from ms_slam_env.scenes import SCENES, Scene
from ms_slam_env.slam.surfel.surfel_config import SUBMAPS

RETURN, DARK = "return", "dark"
KINDS = (RETURN, DARK, FOREIGN)
COLUMNS = (
    *("setting", "variant", "attempts_count", "joined_submaps", "wrong_joins", "link_error_m"),
    *("frames_to_join", "lost_share", "unjoined_share", "ate_unaligned_m"),
    *("final_ate_unaligned_m", "submap_ate_m", "cpu_ms_median"),
)
WRONG_M, WRONG_DEG = 0.05, 5.0
TURN_DEG, STEP_DEG = 150.0, 3.0  # turn away from the end of the mapped stretch; per frame
DARK_DEG = 60.0  # part of the turn during which frames are black
_OTHER_SEED = 500  # added to a scene's seed for another scene that looks alike


@dataclass(frozen=True)
class SubmapsSpec:
    """One map and the interruptions after it; see :class:`SubmapsExperiment` for the fields."""

    scene: str
    seed: int
    size: str
    kinds: tuple[str, ...]
    variants: tuple[str, ...]
    jumps: int
    map_frames: int
    after: int


@dataclass(frozen=True)
class SubmapsExperiment(Experiment, Checked):
    """Lost cameras that go on: submaps, where they are joined, and what that is worth

    The camera maps a stretch of a path. Return: it suddenly looks in another direction, 150 degrees
    away, turns back and goes back over half of the stretch. Dark: it turns there and back, and sees
    nothing for the first 60 degrees. Foreign: it continues in another scene of the same kind, where
    any joined submap is wrong.
    """

    scenes: tuple[str, ...] = ("living_room", "corridor")
    """Names of scenes; successive maps alternate between them. Corridors have repeated parts."""
    size: str = "160x120"
    settings: tuple[str, ...] = KINDS
    """Kinds of interruption."""
    variants: tuple[str, ...] = SUBMAPS
    """Variants of the submaps."""
    maps: int = bounded(10, 1, 100)
    """Number of maps, each with its own seed."""
    jumps: int = bounded(10, 1, 1000)
    """Foreign places after each map; the other settings occur once per map."""
    map_frames: int = bounded(60, 20, 100_000)
    """Length of the mapped stretch, in frames."""
    after: int = bounded(30, 10, 100_000)
    """Frames in a foreign place."""
    seeds: str = "validation"
    """Split that the seeds come from; do not derive defaults from test seeds."""

    unit = "maps"

    def specs(self) -> list[SubmapsSpec]:
        """Every map."""
        check_each("scene", self.scenes, SCENES)
        check_each("setting", self.settings, KINDS)
        check_each("variant", self.variants, SUBMAPS)
        check_names(self)
        seeds = seed_list(self.seeds, self.maps)
        return [
            self.spec(SubmapsSpec, scene=scene, seed=seed, kinds=self.settings)
            for scene, seed in zip(cycle(self.scenes), seeds, strict=False)
        ]

    @staticmethod
    def run(spec: SubmapsSpec) -> dict[str, Any]:
        """Map a stretch with every variant, and put each through every interruption."""
        scene = scenes.make(spec.scene, spec.seed)
        intrinsics = xtion(spec.size)
        path = map_path(scene, spec.map_frames, spec.seed)
        frames = _record(scene, intrinsics, spec.seed, 0, path)
        interruptions = _interruptions(spec, scene, intrinsics, path)
        attempts = []
        for variant in spec.variants:
            backend = slam.make("surfel", intrinsics, submaps=variant)
            mapping = run_sequence(backend, frames, start=path[0])
            state = backend.get_state()
            drift = mapping.estimates[-1] @ invert(path[-1])  # where the camera returns
            for one in interruptions:
                if variant == "off" and one.truth is None:
                    continue  # it joins nothing
                backend.set_state(state)
                run = run_sequence(backend, one.frames, reset=False)
                figures = _measure(run, one, len(frames), drift)
                attempts.append({"setting": one.setting, "variant": variant, **figures})
        return {"attempts": attempts}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line for each setting and variant."""
        cells = grouped(flattened(rows, "attempts"), ("setting", "variant"))
        note = "Means of counts and shares, medians of the rest, with 95 % intervals."
        return [make_table(COLUMNS, [_line(*cell) for cell in cells.items()], note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error of the final poses by setting."""
        lines: Any = [line for line in self.tables(rows)[0].rows if line["setting"] != FOREIGN]
        key, series = "final_ate_unaligned_m", []
        for variant in dict.fromkeys(line["variant"] for line in lines):
            own = [line for line in lines if line["variant"] == variant]
            values = [line[key] for line in own]
            names = [line["setting"] for line in own]
            series.append(interval_series(variant, names, values, "markers"))
        caption = "Mark: median over the attempts; bar: its 95 % interval."
        return [Chart("submaps", "Error of the final poses", caption, [Panel("", key, series)])]


@dataclass(frozen=True)
class Interruption:
    """Frames that the camera sees after an interruption."""

    setting: str
    frames: list[RGBDFrame]  # N, the first of which are black
    black: int  # number of black frames
    truth: Float64 | None  # (N, 4, 4) true poses; None in a foreign place


def _interruptions(
    spec: SubmapsSpec, scene: Scene, intrinsics: Intrinsics, path: Float64
) -> list[Interruption]:
    """Interruptions of a camera that has reached the end of ``path`` (N, 4, 4)."""
    away, hidden = np.arange(0, TURN_DEG, STEP_DEG), int(DARK_DEG / STEP_DEG)
    back = np.concatenate([_turned(path[-1], away[::-1]), path[: len(path) // 2 : -1]])
    paths = {RETURN: (back, 0), DARK: (np.concatenate([_turned(path[-1], away), back]), hidden)}
    found = []
    for number, (setting, (poses, black)) in enumerate(paths.items(), start=1):
        if setting in spec.kinds:
            frames = _record(scene, intrinsics, spec.seed, 10_000 * number, poses)
            frames[:black] = [_black(frame) for frame in frames[:black]]
            found.append(Interruption(setting, frames, black, poses))
    if FOREIGN in spec.kinds:
        for seed in range(spec.seed + _OTHER_SEED, spec.seed + _OTHER_SEED + spec.jumps):
            other = scenes.make(spec.scene, seed)
            frames = _record(other, intrinsics, seed, 0, map_path(other, spec.after, seed))
            found.append(Interruption(FOREIGN, frames, 0, None))
    return found


def _turned(pose: Float64, degrees: Float64) -> Float64:
    """Poses (N, 4, 4) of a camera that turns about the vertical and moves slightly aside."""
    turned = np.repeat(pose[None], len(degrees), axis=0)
    turned[:, :3, :3] = [so3_exp([0, 0, angle]) @ pose[:3, :3] for angle in np.radians(degrees)]
    turned[:, 2, 3] += 0.001 * degrees
    return turned


def _black(frame: RGBDFrame) -> RGBDFrame:
    return RGBDFrame(np.zeros_like(frame.color), np.zeros_like(frame.depth), frame.timestamp)


def _record(
    scene: Scene, intrinsics: Intrinsics, seed: int, first: int, poses: Float64
) -> list[RGBDFrame]:
    sensor = sensors.RGBDSensor(scene, intrinsics, seed=seed)
    return [sensor.capture(pose, first + index) for index, pose in enumerate(poses)]


def _measure(run: SequenceRun, one: Interruption, mapped: int, drift: Float64) -> dict[str, Any]:
    """Result of an interruption after ``mapped`` frames, whose map has a ``drift`` (4, 4)."""
    joints = [k for k, result in enumerate(run.results) if result.submaps_joined]
    figures = {
        **submap_measures(run),
        "lost_share": float(1 - run.tracking_ok[one.black :].mean()),
        "cpu_ms_median": float(np.median(run.cpu_ms)),
    }
    if one.truth is None:
        return {**figures, "wrong_joins": len(joints)}
    numbers, poses = run.backend.corrected_trajectory()
    final = run.estimates
    final[numbers[numbers >= mapped] - mapped] = poses[numbers >= mapped]
    errors = [pose_error(run.estimates[k], drift @ one.truth[k]) for k in joints]
    anchored = np.flatnonzero(run.anchored[one.black :])
    return {
        **figures,
        "wrong_joins": sum(m > WRONG_M or deg > WRONG_DEG for m, deg in errors),
        "link_error_m": [m for m, _ in errors],
        "link_error_deg": [deg for _, deg in errors],
        "frames_to_join": float(anchored[0]) if len(anchored) else math.inf,
        "ate_unaligned_m": metrics.ate_rmse(run.estimates, one.truth, align="none"),
        "final_ate_unaligned_m": metrics.ate_rmse(final, one.truth, align="none"),
        **submap_errors(final, one.truth, submap_numbers(run)),
    }


def _line(key: tuple[Any, ...], attempts: list[Row]) -> dict[str, Value]:
    setting, variant = key
    errors = [error for attempt in attempts for error in attempt.get("link_error_m", ())]
    found = [a for a in attempts if math.isfinite(a.get("frames_to_join", math.inf))]
    shown = [name for name in COLUMNS[7:] if name in attempts[0]]
    return {
        "setting": setting,
        "variant": variant,
        "attempts_count": len(attempts),
        "joined_submaps": sum(attempt["joined_submaps"] for attempt in attempts),
        "wrong_joins": sum(attempt["wrong_joins"] for attempt in attempts),
        "link_error_m": float(np.median(errors)) if errors else None,
        "frames_to_join": summary(found, "frames_to_join") if found else None,
        **{name: summary(attempts, name) for name in shown},
    }
