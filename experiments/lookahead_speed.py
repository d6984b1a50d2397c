"""Measure the time of the lookahead: 49 predicted views and divergences, for a given map size."""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ms_slam_env import scenes
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.env.env_config import EnvConfig, LookaheadConfig
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.errors import InputError
from ms_slam_env.report.tables import Row, Table, finished, make_table
from ms_slam_env.robot.action_primitives import NUM_MOTIONS, decompose
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import handheld_trajectory
from ms_slam_env.slam.surfel import SurfelSlam

STAGES = {
    "cull the surfels": ("rendering.py", "cull"),
    "render two layers": ("rendering.py", "_draw"),
    "collect points": ("view_prediction.py", "_collect"),
    "warp into the views": ("view_prediction.py", "_warp"),
    "copy to the host": ("surfel_map.py", "predict"),
    "histograms": ("counting.py", "histograms"),
    "divergences": ("measures.py", "divergence"),
}
"""Stage to (file, function); its time includes callees, except the copy to the host."""


@dataclass(frozen=True)
class LookaheadSpec:
    """One measurement; see :class:`LookaheadSpeed` for the fields."""

    scene: str
    seed: int
    size: str
    surfels: int
    scale: float
    step_m: float
    step_deg: float
    repeats: int


@dataclass(frozen=True)
class LookaheadSpeed(Experiment, Checked):
    """Time of the lookahead and of its parts

    Predicts 49 candidates from the map of a noisy hand-held trajectory, and compares them with the
    current view. The parts are profiled, which exaggerates the cost of short ones.
    """

    scene: str = "living_room"
    """Scene to map."""
    seed: int = 0
    """Seed of scene, trajectory and noise."""
    size: str = "160x120"
    """Image size of the live camera."""
    surfels: int = bounded(50_000, 1000, 190_000)
    """Smallest number of surfels in the map."""
    scale: float = bounded(LookaheadConfig().scale, 0.1, 1.0)
    """Scale of the predicted images."""
    step_m: float = EnvConfig.step_m
    """Translation of the candidates."""
    step_deg: float = round(float(np.degrees(EnvConfig.step_rad)), 6)
    """Rotation of the candidates."""
    repeats: int = bounded(30, 1, 10_000)
    """Number of lookaheads timed."""

    unit = "measurements"
    workers = 1

    def specs(self) -> list[LookaheadSpec]:
        """The one measurement."""
        xtion(self.size)
        return [LookaheadSpec(**asdict(self))]

    @staticmethod
    def run(spec: LookaheadSpec) -> dict[str, Any]:
        """Times of the lookahead and of its parts."""
        slam, frame = build_map(spec)
        pose = slam.track(frame).T_world_camera
        candidates: Float64 = pose @ decompose(spec.step_m, np.radians(spec.step_deg))
        config = LookaheadConfig(scale=spec.scale)
        lookahead = Lookahead(config, DivergenceConfig(), slam.intrinsics)

        def look() -> Float64:
            return lookahead.divergences(slam, candidates, pose, frame)

        def predict() -> object:
            return slam.map.predict_device(candidates[None], spec.scale)

        look()  # the first call compiles and allocates
        return {
            "surfels": slam.map.count(),
            "views": NUM_MOTIONS,
            "stages": [
                {"stage": "lookahead", **_milliseconds(look, spec.repeats)},
                {"stage": "prediction", **_milliseconds(predict, spec.repeats)},
                *_profile(look, spec.repeats),
            ],
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per part."""
        columns = ("stage", "stage_ms", "stage_ms_p90", "stage_cpu_ms")
        return [
            make_table(
                columns,
                row["result"]["stages"],
                note=f"{row['result']['views']} views from {row['result']['surfels']} surfels.",
            )
            for row in finished(rows)
        ]


def build_map(spec: LookaheadSpec) -> tuple[SurfelSlam, RGBDFrame]:
    """Run SLAM on a noisy hand-held trajectory until its map is large enough.

    Raises:
        InputError: the scene is too small for a map of this size.
    """
    scene = scenes.make(spec.scene, seed=spec.seed)
    intrinsics = xtion(spec.size)
    sensor = RGBDSensor(scene, intrinsics, seed=spec.seed)
    slam = SurfelSlam(intrinsics)
    for index, pose in enumerate(handheld_trajectory(scene, 2000, spec.seed)):
        if index == 0:
            slam.reset(pose)
        frame = sensor.capture(pose, index)
        slam.track(frame)
        if slam.map.count() >= spec.surfels:
            return slam, frame
    raise InputError(
        f"scene {spec.scene!r} gave a map of {slam.map.count()} surfels, not {spec.surfels}"
    )


def _milliseconds(call: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median and spread of the wall-clock time, and the median processor time, of ``call``."""
    wall, cpu = [], []
    for _ in range(repeats):
        start, start_cpu = time.perf_counter(), time.process_time()
        call()
        wall.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - start_cpu))
    return {
        "stage_ms": float(np.median(wall)),
        "stage_ms_p90": float(np.quantile(wall, 0.9)),
        "stage_cpu_ms": float(np.median(cpu)),
    }


def _profile(call: Callable[[], object], repeats: int) -> list[dict[str, Any]]:
    """Milliseconds per call of each stage."""
    profiler = cProfile.Profile()
    profiler.enable()
    for _ in range(repeats):
        call()
    profiler.disable()
    functions = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    stages = []
    for stage, (file, name) in STAGES.items():
        seconds = [
            own if stage == "copy to the host" else cumulative
            for (path, _, function), (_, _, own, cumulative, _) in functions.items()
            if function == name and path.endswith(file)
        ]
        stages.append({"stage": stage, "stage_ms": 1e3 * max(seconds, default=0.0) / repeats})
    return stages
