"""Measure the frames per second of many surfel SLAMs in one batch, on the CPU and on a GPU."""

from __future__ import annotations

import gc
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded, check_range, chosen, nested_options
from ms_slam_env.errors import InputError
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.report.tables import Row, Table, finished, make_table
from ms_slam_env.sequences import handheld_trajectory, render_sequence
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig

COLUMNS = (
    *("device", "batch", "frames_per_s", "frames_per_cpu_s", "batch_ms", "mb_per_env"),
    *("surfels", "ate_unaligned_m", "lost_frames"),
)


@dataclass(frozen=True)
class BatchSpec:
    """One size of a batch; see :class:`SlamBatch` for the fields."""

    device: str
    batch: int
    size: str
    scene: str
    seed: int
    sequences: int
    frames: int
    warm_up: int
    max_surfels: int
    backend: tuple[str, ...]


@dataclass(frozen=True)
class SlamBatch(Experiment, Checked):
    """Frames a second of many surfel SLAMs in one batch

    All run in lockstep; frames come from host memory, as in an environment.
    """

    device: str = chosen("cpu", "cpu", "cuda")
    """cpu or cuda."""
    batch: tuple[int, ...] = (1, 4, 16)
    """Numbers of SLAMs in a batch."""
    size: str = "160x120"
    """Image size."""
    scene: str = "living_room"
    """Scene in which to render the sequences."""
    seed: int = 2000
    """Seed of the scene; sequence k has trajectory and noise of ``seed + k``."""
    sequences: int = bounded(8, 1, 1000)
    """Number of different sequences; larger batches repeat them."""
    frames: int = bounded(30, 2, 100_000)
    """Number of frames of a sequence."""
    warm_up: int = 10
    """Frames before the measurement."""
    max_surfels: int = bounded(60_000, 1000, 50_000_000)
    """Capacity of a map, which determines the memory per SLAM."""
    backend: tuple[str, ...] = ()
    """Parameters of SLAM that differ from the default, as in coverage_px=0.9."""

    unit = "batches"
    workers = 1

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        super().__post_init__()
        check_range(self, "warm_up", 1, self.frames - 1)
        if not self.batch or not all(1 <= envs <= 65_536 for envs in self.batch):
            raise InputError(f"batch = {self.batch} must hold integers in [1, 65536]")

    def specs(self) -> list[BatchSpec]:
        """Every size of a batch."""
        xtion(self.size)
        SurfelConfig(**nested_options(self.backend))
        return [self.spec(BatchSpec, batch=batch) for batch in self.batch]

    def prepare(self) -> None:
        """Refuse a GPU that does not exist."""
        check_device(self.device)

    @staticmethod
    def run(spec: BatchSpec) -> dict[str, Any]:
        """Run all SLAMs in lockstep."""
        images = render(spec.scene, spec.seed, spec.sequences, spec.frames, spec.size)
        return measure(spec, *images)

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per batch."""
        return [make_table(COLUMNS, [{**row["spec"], **row["result"]} for row in finished(rows)])]


@lru_cache(maxsize=1)
def render(
    scene_name: str, seed: int, sequences: int, frames: int, size: str
) -> tuple[NDArray[np.uint8], NDArray[np.float32], Float64]:
    """Colour (K, N, H, W, 3), depth (K, N, H, W) and poses (K, N, 4, 4) of K sequences."""
    scene = scenes.make(scene_name, seed)
    colors, depths, poses = [], [], []
    for number in range(seed, seed + sequences):
        path = handheld_trajectory(scene, frames, number, 0.015, 1.0)
        sequence = render_sequence(scene, path, xtion(size), "kinect", number)
        colors.append(np.stack([frame.color for frame in sequence.frames]))
        depths.append(np.stack([frame.depth for frame in sequence.frames]))
        poses.append(np.stack(list(sequence.poses)))
    return np.stack(colors), np.stack(depths), np.stack(poses)


def measure(
    spec: BatchSpec, color: NDArray[np.uint8], depth: NDArray[np.float32], poses: Float64
) -> dict[str, Any]:
    """Speed, memory and error of one batch; images and poses come from `render`."""
    batch, which = spec.batch, np.arange(spec.batch) % len(poses)
    config = SurfelConfig(**{"max_surfels": spec.max_surfels, **nested_options(spec.backend)})
    slam, size = device_bytes(
        lambda: BatchedSurfelSlam(batch, xtion(spec.size), config, spec.device)
    )
    for env in range(batch):
        slam.reset(poses[which[env], 0], env)
    estimates, lost = [], 0
    wall = cpu = 0.0
    for step in range(spec.frames):
        images, distances = color[which, step], depth[which, step]
        start, cpu_start = time.perf_counter(), time.process_time()
        found = slam.track_arrays(images, distances)
        wp.synchronize_device(spec.device)
        if step >= spec.warm_up:
            wall += time.perf_counter() - start
            cpu += time.process_time() - cpu_start
        estimates.append(found.T_world_camera)
        lost += int((~found.tracking_ok).sum())
    steps = spec.frames - spec.warm_up
    errors = [
        ate_rmse(np.stack(estimates)[:, env], poses[which[env]], align="none")
        for env in range(min(batch, len(poses)))
    ]
    return {
        "frames_per_s": batch * steps / wall,
        "frames_per_cpu_s": batch * steps / cpu,
        "batch_ms": 1e3 * wall / steps,
        "mb_per_env": size / batch / 1e6,
        "surfels": float(np.mean(slam.map.surfels.count.numpy() - slam.map.surfels.dead.numpy())),
        "ate_unaligned_m": float(np.median(errors)),
        "lost_frames": lost,
    }


def check_device(device: str) -> None:
    """Refuse a GPU that does not exist."""
    if device == "cuda" and not wp.is_cuda_available():
        raise InputError("not measured on a GPU: this machine has no CUDA device")


def device_bytes(make: Any) -> tuple[Any, int]:
    """Return value of ``make``, and the bytes of the device arrays that it allocated."""
    gc.collect()
    before = {id(thing) for thing in gc.get_objects() if isinstance(thing, wp.array)}
    made = make()
    sizes: dict[int, int] = {}  # views of an array share its address
    for thing in gc.get_objects():
        if isinstance(thing, wp.array) and id(thing) not in before and thing.ptr:
            sizes[thing.ptr] = max(sizes.get(thing.ptr, 0), thing.capacity)
    return made, sum(sizes.values())
