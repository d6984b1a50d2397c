"""Which second copies does the rule of :mod:`ms_slam_env.metrics.consistency` find?

Maps are made at known poses, and half way through every pose is off by a known distance, so that
what is seen before and after is there twice. Run as
``python -m ms_slam_env.benchmark.map_consistency_check --help``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import slam as slam_backends
from ms_slam_env.benchmark.planner_report import finished
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.duplicate_objects import JudgedMap, judge_map, labelled_view
from ms_slam_env.experiments.harness.episodes import check_names, seed_list
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.experiments.pictures.judged_map import save_map_picture
from ms_slam_env.geometry import invert, se3_exp, se3_log
from ms_slam_env.metrics.consistency import ConsistencyRule
from ms_slam_env.report import statistics
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, markdown_table
from ms_slam_env.robot import FreeCamera
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor.scene_cache import get_sensor

PROGRAM = "python -m ms_slam_env.benchmark.map_consistency_check"
Float64 = NDArray[np.float64]

IMAGE_SIZE = "160x120"
MOTIONS = 40
FRAMES_A_MOTION = 6
STEP_M, STEP_DEG = 0.08, 8.0
POSE_NOISE_M = 0.003  # of every estimated position: also a good map is not perfect
VIEW_INTERVAL = 2


@dataclass(frozen=True)
class CopySpec:
    """One map.

    Attributes:
        scene: name of the scene.
        seed: of the scene, the camera's random walk and the noise.
        offset_m: distance by which the second half of the poses is off.
        axis: of the world along which, 0 to 2.
        rule: when the map has failed.
    """

    scene: str
    seed: int
    offset_m: float
    axis: int
    rule: ConsistencyRule


@dataclass(frozen=True)
class Arguments:
    """How many maps with second copies at known distances fail by the rule."""

    scenes: tuple[str, ...] = ("window", "table", "wall", "carpet")
    """Names of scenes, or mesh files."""
    offsets_cm: tuple[float, ...] = (0, 3, 6, 10, 20)
    """Distances of the second copies, along each axis of the world; 0 is one good map."""
    episodes: int = 2
    """Seeds for each scene."""
    seeds: str = "validation"
    """Split that the seeds come from."""
    rule: ConsistencyRule = field(default_factory=ConsistencyRule)
    """When an object counts as present twice."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/map_consistency")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse distances that are none."""
        if not self.offsets_cm or not all(0 <= x < math.inf for x in self.offsets_cm):
            raise InputError(f"offsets_cm = {self.offsets_cm} must be finite and not negative")

    def specs(self) -> list[CopySpec]:
        """Every map; those of one scene and seed are neighbours and share its geometry."""
        return [
            CopySpec(scene, seed, offset / 100, axis, self.rule)
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for offset in self.offsets_cm
            for axis in ((0, 1, 2) if offset else (0,))
        ]


def run(spec: CopySpec, pictures: Path | None = None) -> dict[str, Any]:
    """Make one map and judge it.

    Returns:
        ``failed``, ``worst_share`` (of any object's points, apart from its surface) and
        ``duplicated`` (name to that share).
    """
    judged, cameras = make_map(spec)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        axis, cm = "xyz"[spec.axis], f"{100 * spec.offset_m:g}"
        title = (
            f"{Path(spec.scene).stem}, seed {spec.seed}, second half off by {cm} cm along {axis}"
        )
        name = f"{Path(spec.scene).stem}_{spec.seed}_{cm}cm_{axis}.png"
        save_map_picture(judged, cameras, pictures / name, title)
    consistency = judged.consistency
    return {
        "failed": not consistency.success,
        "worst_share": max((item.apart_share for item in consistency.objects), default=math.nan),
        "duplicated": {judged.name(item): item.apart_share for item in consistency.duplicated},
    }


def make_map(spec: CopySpec) -> tuple[JudgedMap, Float64]:
    """The judged map, and the positions (N, 3) at which SLAM was told the camera was."""
    sensor = get_sensor(spec.scene, spec.seed, IMAGE_SIZE, "kinect")
    rng = np.random.default_rng(spec.seed)
    truth = random_walk(sensor.scene, rng)
    estimate = truth.copy()
    estimate[:, :3, 3] += rng.normal(0, POSE_NOISE_M, (len(truth), 3))
    estimate[len(truth) // 2 :, spec.axis, 3] += spec.offset_m
    slam = slam_backends.make("surfel", sensor.intrinsics)
    for k, (T_true, T_estimate) in enumerate(zip(truth, estimate, strict=True)):
        slam.fuse(sensor.capture(T_true, index=k, seed=spec.seed), T_estimate)
    views = [
        labelled_view(sensor, truth[k], estimate[k]) for k in range(0, len(truth), VIEW_INTERVAL)
    ]
    judged = judge_map(slam.surface_points(), slam.surface_colors(), views, sensor, spec.rule)
    return judged, estimate[:, :3, 3]


def random_walk(scene: Scene, rng: np.random.Generator) -> Float64:
    """Poses (N, 4, 4) of a free camera on a random walk, several on each motion."""
    camera = FreeCamera(scene, STEP_M, math.radians(STEP_DEG))
    camera.reset(scene.sample_start(rng), rng)
    poses = [camera.T_world_camera.copy()]
    for _ in range(MOTIONS):
        before = camera.T_world_camera.copy()
        camera.move(int(rng.choice(np.flatnonzero(camera.action_masks()))))
        twist = se3_log(invert(before) @ camera.T_world_camera)
        poses += [
            before @ se3_exp(twist * part / FRAMES_A_MOTION)
            for part in range(1, FRAMES_A_MOTION + 1)
        ]
    return np.stack(poses)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the check; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(("stationary",), args.scenes)
    rows = run_all(
        args.specs(), partial(run, pictures=args.out / "maps"), args.out, args.workers, "maps"
    )
    check_any_finished(rows)
    summary = summarise(rows)
    write_json(
        args.out / "results.json",
        {
            "provenance": provenance(),
            "seeds": seed_list(args.seeds, args.episodes),
            "rule": asdict(args.rule),
            "summary": [
                {"offset_m": offset, **{name: asdict(value) for name, value in cell.items()}}
                for offset, cell in summary.items()
            ],
            "maps": rows,
        },
    )
    table = as_table(rows)
    (args.out / "table.md").write_text(table)
    print(table)
    return report_failures(failures(rows), PROGRAM)


def summarise(rows: Sequence[Row]) -> dict[float, dict[str, Interval]]:
    """Share of maps that fail and the median of the worst object's share, by offset in metres."""
    cells: dict[float, list[dict[str, Any]]] = {}
    for row in finished(rows):
        cells.setdefault(row["spec"]["offset_m"], []).append(row["result"])
    return {
        offset: {
            "failed": statistics.share_interval([r["failed"] for r in results]),
            "worst_share": statistics.median_interval(
                [r["worst_share"] for r in results if not math.isnan(r["worst_share"])]
            ),
        }
        for offset, results in sorted(cells.items())
    }


def as_table(rows: Sequence[Row]) -> str:
    """Markdown table, one line a distance."""
    body = []
    for offset, cell in summarise(rows).items():
        count = sum(row["spec"]["offset_m"] == offset for row in finished(rows))
        shares = [format_interval(cell[name], 100) for name in ("failed", "worst_share")]
        body.append([f"{100 * offset:g}", str(count), *shares])
    return markdown_table(
        ["second copy off by [cm]", "maps", "failed [%]", "worst object's share apart [%]"], body
    )


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
