"""Which second copies of objects does the duplicate-object check find?

Maps are made at known poses, and half way through every pose is off by a known distance, so that
what is seen before and after is there twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.pictures.judged_map import save_map_picture

from ms_slam_env import slam as slam_backends
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import check_names, seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.duplicate_objects import JudgedMap, judge_map, labelled_view
from ms_slam_env.geometry import invert, se3_exp, se3_log
from ms_slam_env.metrics.consistency import ConsistencyRule
from ms_slam_env.report.charts import Chart, over_field
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Grouping, Table
from ms_slam_env.robot import FreeCamera
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor.scene_cache import get_sensor

IMAGE_SIZE = "160x120"
MOTIONS = 40
FRAMES_A_MOTION = 6
STEP_M, STEP_DEG = 0.08, 8.0
POSE_NOISE_M = 0.003  # of every estimated position: also a good map is not perfect
VIEW_INTERVAL = 2
METRICS = ("success", "worst_apart_share")


@dataclass(frozen=True)
class CopySpec:
    """One map.

    Attributes:
        scene: name of the scene.
        seed: of the scene, the camera's random walk and the noise.
        offset_m: distance by which the second half of the poses is off.
        axis: of the world along which, 0 to 2.
        rule: when the map has failed.
        picture: where a picture of the judged map goes; empty for none.
    """

    scene: str
    seed: int
    offset_m: float
    axis: int
    rule: ConsistencyRule
    picture: str = ""


@dataclass(frozen=True)
class DuplicateObjects(Experiment):
    """Which second copies of objects the duplicate-object check finds

    Maps whose second half is off by a known distance along each axis of the world.
    """

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
    pictures: Path | None = None
    """Folder of pictures of the judged maps; none by default."""

    unit = rows_key = "maps"

    def __post_init__(self) -> None:
        """Refuse distances that are none."""
        if not self.offsets_cm or not all(0 <= x < math.inf for x in self.offsets_cm):
            raise InputError(f"offsets_cm = {self.offsets_cm} must be finite and not negative")

    @staticmethod
    def run(spec: CopySpec) -> dict[str, Any]:
        """Make one map and judge it."""
        judged, cameras = make_map(spec)
        if spec.picture:
            off = f"{100 * spec.offset_m:g} cm along {'xyz'[spec.axis]}"
            title = f"{Path(spec.scene).stem}, seed {spec.seed}, second half off by {off}"
            save_map_picture(judged, cameras, Path(spec.picture), title)
        return judged.verdict()

    def specs(self) -> list[CopySpec]:
        """Every map; those of one scene and seed are neighbours and share its geometry."""
        check_names(("stationary",), self.scenes)
        return [
            CopySpec(
                scene,
                seed,
                offset / 100,
                axis,
                self.rule,
                self._picture(f"{Path(scene).stem}_{seed}_{offset:g}cm_{'xyz'[axis]}"),
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for offset in self.offsets_cm
            for axis in ((0, 1, 2) if offset else (0,))
        ]

    def _picture(self, name: str) -> str:
        return str(self.pictures / f"{name}.png") if self.pictures else ""

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line a distance."""
        by_distance = sorted(rows, key=lambda row: row["spec"]["offset_m"])
        grouping = Grouping(("offset_m",), METRICS, count="map_count")
        note = "Share of maps that show nothing twice with its 95 % Wilson interval, and a median."
        return [grouping.table(by_distance, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Both measures over the distance."""
        panels = over_field(rows, "offset_m", METRICS)
        caption = "Share of maps, and median over maps, with 95 % intervals."
        return [Chart("duplicate_objects", "Verdict by distance of the copy", caption, panels)]


def make_map(spec: CopySpec) -> tuple[JudgedMap, Float64]:
    """The judged map, and the positions (N, 3) at which SLAM was told the camera was."""
    sensor = get_sensor(spec.scene, spec.seed, xtion(IMAGE_SIZE), "kinect")
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
