"""Time of the lookahead: 49 predicted views and their divergences, from a map of given size.

``ms-slam experiment lookahead-speed --out DIR`` writes ``lookahead_speed.json``.
"""

from __future__ import annotations

import cProfile
import json
import pstats
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.config import check_range
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.env.config import EnvConfig, LookaheadConfig
from ms_slam_env.env.lookahead import Lookahead
from ms_slam_env.errors import InputError
from ms_slam_env.report.provenance import provenance
from ms_slam_env.robot.action_primitives import NUM_MOTIONS, decompose
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import handheld_trajectory
from ms_slam_env.slam.surfel import SurfelSlam

Float64 = NDArray[np.float64]

STAGES = {
    "cull the surfels": ("splat_renderer.py", "cull"),
    "render two layers": ("splat_renderer.py", "splat"),
    "list hidden surfels": ("splat_renderer.py", "list_hidden"),
    "collect points": ("prediction.py", "_collect"),
    "warp into the views": ("prediction.py", "_warp"),
    "copy to the host": ("surfel_map.py", "predict"),
    "histograms": ("", "histograms"),
    "divergences": ("", "divergence"),
}
"""Stage to (file, function); the time of the last two is theirs and their callees'."""


@dataclass(frozen=True)
class LookaheadSpeedConfig:
    """Options of the measurement.

    Attributes:
        out: folder for the results.
        scene: where the map is made.
        seed: of scene, trajectory and noise.
        size: of the live camera.
        surfels: size of the map, at least.
        scale: of the predicted images.
        step_m: translation of the candidates.
        step_deg: rotation of the candidates.
        repeats: number of lookaheads timed.
    """

    out: Path = Path("results/lookahead_speed")
    scene: str = "living_room"
    seed: int = 0
    size: str = "160x120"
    surfels: int = 50_000
    scale: float = LookaheadConfig().scale
    step_m: float = EnvConfig.step_m
    step_deg: float = round(float(np.degrees(EnvConfig.step_rad)), 6)
    repeats: int = 30

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "surfels", 1000, 190_000)
        check_range(self, "repeats", 1, 10_000)
        check_range(self, "scale", 0.1, 1.0)


def build_map(config: LookaheadSpeedConfig) -> tuple[SurfelSlam, RGBDFrame]:
    """Run SLAM on a noisy hand-held trajectory until its map is large enough.

    Raises:
        InputError: the scene does not fill so large a map.
    """
    scene = scenes.make(config.scene, seed=config.seed)
    intrinsics = xtion(config.size)
    sensor = RGBDSensor(scene, intrinsics, seed=config.seed)
    slam = SurfelSlam(intrinsics)
    for index, pose in enumerate(handheld_trajectory(scene, 2000, config.seed)):
        if index == 0:
            slam.reset(pose)
        frame = sensor.capture(pose, index)
        slam.track(frame)
        if slam.map.count() >= config.surfels:
            return slam, frame
    raise InputError(
        f"scene {config.scene!r} gave a map of {slam.map.count()} surfels, not {config.surfels}"
    )


def _milliseconds(call: Any, repeats: int) -> dict[str, float]:
    """Median and spread of the wall-clock time, and the median processor time, of ``call``."""
    wall, cpu = [], []
    for _ in range(repeats):
        start, start_cpu = time.perf_counter(), time.process_time()
        call()
        wall.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - start_cpu))
    return {
        "wall_ms": float(np.median(wall)),
        "wall_ms_p90": float(np.quantile(wall, 0.9)),
        "cpu_ms": float(np.median(cpu)),
    }


def _profile(call: Any, repeats: int) -> dict[str, float]:
    """Milliseconds a call of each stage."""
    profiler = cProfile.Profile()
    profiler.enable()
    for _ in range(repeats):
        call()
    profiler.disable()
    functions = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    result = {}
    for stage, (file, name) in STAGES.items():
        seconds = [
            own if stage == "copy to the host" else cumulative
            for (path, _, function), (_, _, own, cumulative, _) in functions.items()
            if function == name and path.endswith(file)
        ]
        result[stage] = 1e3 * max(seconds, default=0.0) / repeats
    return result


def measure(config: LookaheadSpeedConfig) -> dict[str, Any]:
    """Times of the lookahead and of its parts."""
    slam, frame = build_map(config)
    pose = slam.track(frame).T_world_camera
    candidates: Float64 = pose @ decompose(config.step_m, np.radians(config.step_deg))
    lookahead = Lookahead(LookaheadConfig(scale=config.scale), DivergenceConfig(), slam.intrinsics)

    def look() -> Float64:
        return lookahead.divergences(slam, candidates, pose, frame)

    look()  # the first call compiles and allocates
    return {
        "surfels": slam.map.count(),
        "views": NUM_MOTIONS,
        "lookahead": _milliseconds(look, config.repeats),
        "prediction": _milliseconds(
            lambda: slam.map.predict_device(candidates[None], config.scale), config.repeats
        ),
        "stages_ms": _profile(look, config.repeats),
    }


def main() -> int:
    """Measure, print and write."""
    config = parse(LookaheadSpeedConfig, None, "lookahead_speed")
    result = measure(config)
    options = {**asdict(config), "out": str(config.out)}
    config.out.mkdir(parents=True, exist_ok=True)
    path = config.out / "lookahead_speed.json"
    path.write_text(
        json.dumps({"provenance": provenance(), "options": options, **result}, indent=2) + "\n"
    )
    print(f"{result['surfels']} surfels, {result['views']} views at scale {config.scale}")
    for part in ("lookahead", "prediction"):
        times = result[part]
        print(
            f"{part:22s} {times['wall_ms']:6.2f} ms (90 %: {times['wall_ms_p90']:.2f}), "
            f"processor {times['cpu_ms']:.2f} ms"
        )
    for stage, milliseconds in result["stages_ms"].items():
        print(f"  {stage:20s} {milliseconds:6.2f} ms")
    print(f"written to {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(exit_code(main, "lookahead_speed"))
