"""Does the SLAM find its pose again after a kidnapping, and never a wrong one?

The camera maps a stretch of a path, then finds itself elsewhere, with or without black frames in
between, and moves on. Run as ``python -m ms_slam_env.benchmark.kidnapping --help``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes, slam
from ms_slam_env.benchmark.kidnapping_report import about_the_maps, as_table, summarise
from ms_slam_env.benchmark.kidnapping_scenarios import (
    ALL_SETTINGS,
    FOREIGN,
    SETTINGS,
    Interruption,
    MappedSpace,
    draw_interruption,
    foreign_interruption,
    map_path,
)
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.experiments.harness.episodes import seed_list
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.metrics import ate_rmse, relocalisation_times
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.scenes import ROOMS, SCENES, Scene
from ms_slam_env.sensor import FRAME_RATE_HZ, RGBDSensor
from ms_slam_env.slam import SlamBackend
from ms_slam_env.slam.surfel.config import RELOCALISATIONS

Float64 = NDArray[np.float64]

PROGRAM = "python -m ms_slam_env.benchmark.kidnapping"
FOUND_M, FOUND_DEG = 0.05, 5.0
WRONG_M, WRONG_DEG = 0.10, 10.0
_OTHER_SEED = 500  # added to a scene's seed for the scene that nothing is known of


@dataclass(frozen=True)
class KidnappingSpec:
    """One map and the interruptions after it.

    Attributes:
        scene: name of the scene.
        seed: of the scene, the path, the noise and the interruptions.
        size: of the images.
        settings: names among ``ALL_SETTINGS``.
        variants: of the relocalisation.
        jumps: interruptions for each setting.
        map_frames: length of the stretch that is mapped.
        after: frames after an interruption.
    """

    scene: str
    seed: int
    size: str
    settings: tuple[str, ...]
    variants: tuple[str, ...]
    jumps: int
    map_frames: int
    after: int


@dataclass(frozen=True)
class Arguments:
    """Kidnap the SLAM's camera: how often, how soon and how truly it finds its pose again."""

    scenes: tuple[str, ...] = ROOMS
    """Names of scenes; the maps take them in turns."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    settings: tuple[str, ...] = ALL_SETTINGS
    """Kinds of interruption."""
    variants: tuple[str, ...] = RELOCALISATIONS
    """Variants of the relocalisation."""
    maps: int = 25
    """Maps, each of its own seed."""
    jumps: int = 4
    """Interruptions of each kind after each map."""
    map_frames: int = 200
    """Length of the stretch that is mapped."""
    after: int = 30
    """Frames after an interruption; in those the pose must be found."""
    seeds: str = "validation"
    """Split that the seeds come from; a default read from them may not use the test seeds."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/kidnapping")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse unknown names and bad counts."""
        for name, given, valid in (
            ("scene", self.scenes, SCENES),
            ("setting", self.settings, ALL_SETTINGS),
            ("variant", self.variants, RELOCALISATIONS),
        ):
            if not given or len(set(given)) < len(given):
                raise InputError(f"{name}s {', '.join(given)!r} must be different, at least one")
            for one in given:
                if one not in valid:
                    raise unknown(name, one, valid)
        for size in self.sizes:
            xtion(size)
        check_range(self, "maps", 1, 100)
        check_range(self, "jumps", 1, 1000)
        check_range(self, "map_frames", 50, 100_000)
        check_range(self, "after", 2, self.map_frames)

    def specs(self) -> list[KidnappingSpec]:
        """Every map."""
        return [
            KidnappingSpec(
                self.scenes[index % len(self.scenes)],
                seed,
                size,
                self.settings,
                self.variants,
                self.jumps,
                self.map_frames,
                self.after,
            )
            for size in self.sizes
            for index, seed in enumerate(seed_list(self.seeds, self.maps))
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    rows = run_all(args.specs(), run_map, args.out, args.workers, "maps")
    check_any_finished(rows)
    summary = summarise(rows)
    content = {
        "provenance": provenance(),
        "config": asdict(args) | {"out": str(args.out)},
        "summary": [asdict(cell) for cell in summary],
        "maps": rows,
    }
    write_json(args.out / "kidnapping.json", content)
    table = as_table(summary) + "\n" + about_the_maps(rows)
    (args.out / "table.md").write_text(table)
    print(table)
    return report_failures(failures(rows), PROGRAM)


def run_map(spec: KidnappingSpec) -> dict[str, Any]:
    """Map a path with every variant and interrupt it; errors of the maps and all attempts."""
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
            interruptions.append(
                (FOREIGN, foreign_interruption(other, spec.after, spec.seed + jump))
            )
            recordings.append(elsewhere.record(interruptions[-1][1].poses))
    maps, attempts = {}, []
    for variant in spec.variants:
        backend = slam.make("surfel", intrinsics, relocalisation=variant)
        maps[variant], estimates = _build_map(backend, mapped, path)
        if maps[variant]["lost_frames"]:
            continue  # what its poses are worth is unknown
        state = backend.get_state()
        for (name, one), frames in zip(interruptions, recordings, strict=True):
            backend.set_state(state)
            expected = None
            if name != FOREIGN:
                # Where the map has drifted, it is there that the camera must be found.
                drift = estimates[one.source] @ invert(path[one.source])
                expected = drift @ one.poses
            outcome = interrupt(backend, one, frames, expected)
            attempts.append({"variant": variant, "setting": name, **outcome})
    return {"maps": maps, "attempts": attempts}


class _Recorder:
    """Takes frames in a scene, each with noise of its own."""

    def __init__(self, scene: Scene, intrinsics: Intrinsics, seed: int) -> None:
        self._sensor = RGBDSensor(scene, intrinsics, seed=seed)
        self._taken = 0

    def record(self, poses: Float64) -> list[RGBDFrame]:
        first = self._taken
        self._taken += len(poses)
        return [self._sensor.capture(pose, first + index) for index, pose in enumerate(poses)]


def _draw(spec: KidnappingSpec, scene: Scene, path: Float64) -> list[tuple[str, Interruption]]:
    """All interruptions within the scene; fewer where no pose there satisfies a setting."""
    drawn: list[tuple[str, Interruption]] = []
    space: MappedSpace | None = None
    for index, (name, setting) in enumerate(SETTINGS.items()):
        if name not in spec.settings:
            continue
        space = space or MappedSpace(scene, path)
        rng = np.random.default_rng([spec.seed, index])
        found = [
            draw_interruption(scene, path, space, setting, spec.after, rng)
            for _ in range(spec.jumps)
        ]
        drawn += [(name, one) for one in found if one is not None]
    return drawn


def _build_map(
    backend: SlamBackend, frames: list[RGBDFrame], path: Float64
) -> tuple[dict[str, Any], list[Float64]]:
    """Map the path; figures about it, and the estimated poses."""
    backend.reset(path[0])
    estimates, times, lost = [], [], 0
    for frame in frames:
        start = time.process_time()
        result = backend.track(frame)
        times.append(time.process_time() - start)
        lost += not result.tracking_ok
        estimates.append(result.T_world_camera)
    figures = {
        "ate_m": ate_rmse(estimates, path, align="none"),
        "lost_frames": lost,
        "frame_ms": float(np.median(times) * 1e3),
    }
    return figures, estimates


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
        ``found``: whether a pose within 5 cm and 5 degrees of the expected one was given;
        ``wrong``: whether a pose farther than 10 cm or 10 degrees off was, or any where none is
        expected; ``first``: frames before the first pose (None without one) and
        ``relocalisation_s`` the same in seconds (USME equation 11); ``first_error_m``,
        ``first_error_deg`` of that pose; ``lost_frame_ms``: mean processor time of the frames
        before it; ``black``, ``mapped``: of the interruption; ``black_tracked``: black frames
        for which a pose was given.
    """
    height, width = frames[0].depth.shape
    nothing = RGBDFrame(
        np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    )
    black_tracked = sum(backend.track(nothing).tracking_ok for _ in range(one.black))
    found = wrong = False
    tracked: list[bool] = []
    times: list[float] = []
    first_error: tuple[float, float] | None = None
    for index, frame in enumerate(frames):
        start = time.process_time()
        result = backend.track(frame)
        if not any(tracked):
            times.append(time.process_time() - start)
        tracked.append(result.tracking_ok)
        if result.tracking_ok and expected is not None:
            error_m, error_deg = _error(result.T_world_camera, expected[index])
            first_error = first_error or (error_m, error_deg)
            found |= error_m < FOUND_M and error_deg < FOUND_DEG
            wrong |= error_m > WRONG_M or error_deg > WRONG_DEG
        wrong |= result.tracking_ok and expected is None
    seconds = np.arange(len(frames) + 1) / FRAME_RATE_HZ
    interrupted = [True] + [False] * len(frames)
    relocalised_s = float(relocalisation_times(seconds, interrupted, [False, *tracked])[0])
    return {
        "found": found,
        "wrong": wrong,
        "first": tracked.index(True) if any(tracked) else None,
        "relocalisation_s": relocalised_s if np.isfinite(relocalised_s) else None,
        "first_error_m": first_error[0] if first_error else None,
        "first_error_deg": first_error[1] if first_error else None,
        "lost_frame_ms": float(np.mean(times) * 1e3),
        "black": one.black,
        "black_tracked": black_tracked,
        "mapped": one.mapped,
    }


def _error(estimate: Float64, truth: Float64) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return distance, float(np.degrees(relative_angle(estimate[:3, :3], truth[:3, :3])))


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
