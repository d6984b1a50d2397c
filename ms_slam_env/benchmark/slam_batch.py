"""Frames a second of many surfel SLAMs in one batch, on the CPU and on a GPU.

``ms-slam experiment slam-batch --device cpu --batch 1 4 16`` writes
``slam_batch.json`` and prints a table.
"""

from __future__ import annotations

import gc
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ms_slam_env import scenes
from ms_slam_env._warp import wp
from ms_slam_env.benchmark.slam_speed import backend_parameters
from ms_slam_env.camera import xtion
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.config import check_choice, check_range
from ms_slam_env.errors import InputError
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.report.tables import format_number, markdown_table
from ms_slam_env.sequences import handheld_trajectory, render_sequence
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig

PROGRAM = "ms-slam experiment slam-batch"
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class SlamBatchConfig:
    """Frames a second of many surfel SLAMs in one batch, on the CPU and on a GPU."""

    out: Path = Path("results/slam_batch")
    """Folder of the results."""
    device: str = "cpu"
    """cpu or cuda."""
    batch: tuple[int, ...] = (1, 4, 16)
    """Numbers of SLAMs in a batch."""
    size: str = "160x120"
    """Image size."""
    scene: str = "living_room"
    """Where the sequences are rendered."""
    seed: int = 2000
    """Of the scene; sequence k has trajectory and noise of ``seed + k``."""
    sequences: int = 8
    """Different sequences; larger batches repeat them."""
    frames: int = 30
    """Length of a sequence."""
    warm_up: int = 10
    """Frames before the measurement."""
    max_surfels: int = 60_000
    """Capacity of a map: it determines the memory of an env."""
    backend: tuple[str, ...] = ()
    """Parameters of the SLAM that differ from the default, ``name=value`` each (JSON values)."""

    def __post_init__(self) -> None:
        """Refuse values out of range.

        Raises:
            InputError: a value out of range.
        """
        check_choice(self, "device", ("cpu", "cuda"))
        check_range(self, "frames", 2, 100_000)
        check_range(self, "warm_up", 1, self.frames - 1)
        check_range(self, "sequences", 1, 1000)
        check_range(self, "max_surfels", 1000, 50_000_000)
        if not self.batch or not all(1 <= envs <= 65_536 for envs in self.batch):
            raise InputError(f"batch = {self.batch} must hold integers in [1, 65536]")


@dataclass(frozen=True)
class BatchResult:
    """One size of a batch on one device.

    ``frames_per_s`` is by the clock, ``frames_per_cpu_s`` by processor time, which a busy machine
    disturbs less; ``ate_mm`` is the median over envs, over the frames measured too.
    """

    device: str
    batch: int
    frames_per_s: float
    frames_per_cpu_s: float
    ms_per_batch: float
    mb_per_env: float
    surfels: float
    ate_mm: float
    lost_frames: int


def device_bytes(make: Any) -> tuple[Any, int]:
    """What ``make`` returns, and the bytes of the device arrays that it allocated."""
    gc.collect()
    before = {id(thing) for thing in gc.get_objects() if isinstance(thing, wp.array)}
    made = make()
    sizes: dict[int, int] = {}  # views of an array share its address
    for thing in gc.get_objects():
        if isinstance(thing, wp.array) and id(thing) not in before and thing.ptr:
            sizes[thing.ptr] = max(sizes.get(thing.ptr, 0), thing.capacity)
    return made, sum(sizes.values())


def render(config: SlamBatchConfig) -> tuple[NDArray[np.uint8], NDArray[np.float32], Float64]:
    """Colour (K, N, H, W, 3), depth (K, N, H, W) and poses (K, N, 4, 4) of K sequences."""
    scene = scenes.make(config.scene, config.seed)
    colors, depths, poses = [], [], []
    for seed in range(config.seed, config.seed + config.sequences):
        path = handheld_trajectory(scene, config.frames, seed, 0.015, 1.0)
        sequence = render_sequence(scene, path, xtion(config.size), "kinect", seed)
        colors.append(np.stack([frame.color for frame in sequence.frames]))
        depths.append(np.stack([frame.depth for frame in sequence.frames]))
        poses.append(np.stack(list(sequence.poses)))
    return np.stack(colors), np.stack(depths), np.stack(poses)


def measure(
    config: SlamBatchConfig,
    batch: int,
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    poses: Float64,
) -> BatchResult:
    """Track all envs in lockstep; frames come from the host, as from an environment."""
    which = np.arange(batch) % len(poses)
    parameters = {"max_surfels": config.max_surfels, **backend_parameters(config.backend)}
    intrinsics, surfel_config = xtion(config.size), SurfelConfig(**parameters)
    slam, size = device_bytes(
        lambda: BatchedSurfelSlam(batch, intrinsics, surfel_config, config.device)
    )
    for env in range(batch):
        slam.reset(poses[which[env], 0], env)
    estimates, lost = [], 0
    wall = cpu = 0.0
    for step in range(config.frames):
        images, distances = color[which, step], depth[which, step]
        start, cpu_start = time.perf_counter(), time.process_time()
        results = slam.track(images, distances)
        wp.synchronize_device(config.device)
        if step >= config.warm_up:
            wall += time.perf_counter() - start
            cpu += time.process_time() - cpu_start
        estimates.append(np.stack([result.T_world_camera for result in results]))
        lost += sum(not result.tracking_ok for result in results)
    steps = config.frames - config.warm_up
    errors = [
        ate_rmse(np.stack(estimates)[:, env], poses[which[env]], align="none")
        for env in range(min(batch, len(poses)))
    ]
    return BatchResult(
        device=config.device,
        batch=batch,
        frames_per_s=batch * steps / wall,
        frames_per_cpu_s=batch * steps / cpu,
        ms_per_batch=1e3 * wall / steps,
        mb_per_env=size / batch / 1e6,
        surfels=float(np.mean(slam.map.surfels.count.numpy() - slam.map.surfels.dead.numpy())),
        ate_mm=1e3 * float(np.median(errors)),
        lost_frames=lost,
    )


def run(config: SlamBatchConfig) -> list[BatchResult]:
    """Measure all sizes of batches and write the report; none on a GPU that is not there.

    Raises:
        InputError: unknown scene, size or parameter.
    """
    results: list[BatchResult] = []
    missing = config.device == "cuda" and not wp.is_cuda_available()
    if not missing:
        images = render(config)
        for batch in tqdm(config.batch, desc="batches", file=sys.stderr):
            results.append(measure(config, batch, *images))
    config.out.mkdir(parents=True, exist_ok=True)
    write_json(
        config.out / "slam_batch.json",
        {
            "provenance": provenance(),
            "config": {key: str(value) for key, value in asdict(config).items()},
            "not_measured": "no CUDA device" if missing else None,
            "results": [asdict(result) for result in results],
        },
    )
    return results


def table(results: list[BatchResult]) -> str:
    """The results as Markdown."""
    header = ["device", "batch", "frames/s", "frames/s of processor time", "ms a batch"]
    header += ["MB per env", "surfels", "ATE mm", "lost frames"]
    lines = []
    for result in results:
        rates = (result.frames_per_s, result.frames_per_cpu_s, result.ms_per_batch)
        cells = [result.device, str(result.batch)]
        cells += [format_number(value, 3) for value in (*rates, result.mb_per_env)]
        lines.append(
            [*cells, f"{result.surfels:.0f}", f"{result.ate_mm:.2f}", str(result.lost_frames)]
        )
    return markdown_table(header, lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the measurement and print its table; return the exit code."""
    config = parse(SlamBatchConfig, arguments, PROGRAM)
    results = run(config)
    if results:
        print(table(results))
    else:
        print("not measured on a GPU: this machine has no CUDA device")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
