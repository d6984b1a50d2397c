"""Measure the steps per second of many environments in one batch, on the CPU and on a GPU."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from ms_slam_experiments.slam_batch import check_device, device_bytes

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env._runtime.threads import available_cores
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.env.batched.batched_env import BatchedActiveSlam
from ms_slam_env.errors import InputError
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table
from ms_slam_env.scenes import SEED_SPLITS
from ms_slam_env.tasks import env_id_of, room

PROCESSES = "processes"
REST = "rest"
ID = env_id_of("room")


@dataclass(frozen=True)
class VectorSpec:
    """One measurement; see :class:`VectorSpeed` for the fields."""

    device: str
    num_envs: int
    image_size: str
    episode_steps: int
    episodes: int
    num_scene_seeds: int
    start_pool: int
    max_surfels: int


@dataclass(frozen=True)
class VectorSpeed(Experiment, Checked):
    """Environment steps a second of the room task in one batch, and beside it in processes

    Random possible actions, with resets. Episodes are short, so that resets are a larger share of
    the work than in the task, whose episodes have 100 steps. The first episode is not measured, nor
    is the time to build the rooms and to compile kernels.
    """

    device: str = chosen("cpu", "cpu", "cuda")
    """cpu or cuda."""
    num_envs: tuple[int, ...] = (1, 8)
    """Numbers of environments in a batch."""
    processes: int | None = bounded(None, 0, 1024)
    """Number of environments in processes of their own; None for one per core, 0 for none."""
    image_size: str = "160x120"
    """Image size, width x height."""
    episode_steps: int = bounded(25, 1, 100_000)
    """Length of an episode."""
    episodes: int = bounded(2, 1, 1000)
    """Number of measured episodes."""
    num_scene_seeds: int = bounded(1, 1, 100)
    """How many rooms of each of the four kinds."""
    start_pool: int = bounded(32, 0, 100_000)
    """Starts drawn once in each room of a batch; 0 draws one at each reset."""
    max_surfels: int = bounded(60_000, 1000, 50_000_000)
    """Capacity of a map in a batch, which determines the memory per environment."""

    unit = "measurements"
    workers = 1

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        super().__post_init__()
        if not self.num_envs or not all(1 <= envs <= 65_536 for envs in self.num_envs):
            raise InputError(f"num_envs = {self.num_envs} must hold integers in [1, 65536]")

    def specs(self) -> list[VectorSpec]:
        """The processes, then every size of a batch."""
        xtion(self.image_size)
        alone = available_cores() if self.processes is None else self.processes
        beside = [self.spec(VectorSpec, device=PROCESSES, num_envs=alone)] if alone else []
        return [*beside, *(self.spec(VectorSpec, num_envs=envs) for envs in self.num_envs)]

    def prepare(self) -> None:
        """Refuse a GPU that does not exist."""
        check_device(self.device)

    @staticmethod
    def run(spec: VectorSpec) -> dict[str, Any]:
        """Speed of one case, and time of each stage of a batch without nested ones."""
        if spec.device == PROCESSES:  # from a process that may have children; this one may not
            command = [sys.executable, "-m", __name__, json.dumps(asdict(spec))]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(done.stderr.strip().splitlines()[-1])
            measured: dict[str, Any] = json.loads(done.stdout)
            return measured
        own: dict[str, Any] = {"device": spec.device, "start_pool": spec.start_pool}
        env, size = device_bytes(lambda: gym.make_vec(f"batched/{ID}", **own, **_options(spec)))
        return {**_drive(env, spec), "mb_per_env": size / spec.num_envs / 1e6}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per case, one column per stage."""
        lines: list[dict[str, Any]] = []
        stages: dict[str, None] = {}
        for row in finished(rows):
            times = {one["stage"]: one["stage_ms"] for one in row["result"]["stages"]}
            stages |= dict.fromkeys(times)
            case = {key: row["spec"][key] for key in ("device", "num_envs")}
            lines.append({**case, **row["result"], **{f"{key}_ms": t for key, t in times.items()}})
        columns: list[Column | str] = [
            *("device", "num_envs", "steps_per_s", "steps_per_cpu_s", "step_ms"),
            Column("mb_per_env", "mb_per_env", "memory an environment"),
            *(Column(f"{stage}_ms", "stage_ms", stage) for stage in stages),
        ]
        return [make_table(columns, lines, note="Stages: mean time a step, by the clock.")]


def _options(spec: VectorSpec) -> dict[str, Any]:
    """What batch and processes have in common."""
    return {
        "num_envs": spec.num_envs,
        "image_size": spec.image_size,
        "num_scene_seeds": spec.num_scene_seeds,
        "max_episode_steps": spec.episode_steps,
        "slam_config": {"max_surfels": spec.max_surfels},
    }


def _drive(env: gym.vector.VectorEnv[Any, Any, Any], spec: VectorSpec) -> dict[str, Any]:
    """Enter every room, then take random possible steps through one episode and measured ones."""
    rng = np.random.default_rng(0)
    rooms = itertools.product(room().scenes, SEED_SPLITS["train"][: spec.num_scene_seeds])
    for scene, seed in rooms:
        env.reset(seed=0, options={"scene": scene, "scene_seed": seed})
    _, info = env.reset(seed=0)
    batch = env if isinstance(env, BatchedActiveSlam) else None
    if batch is not None:
        batch.waits = spec.device == "cuda"  # so that each stage's time is its own
    episode = spec.episode_steps + 1  # the last step resets
    start = processor = 0.0
    for step in range(episode * (1 + spec.episodes)):
        if step == episode:
            start, processor = time.perf_counter(), time.process_time()
            if batch is not None:
                batch.timings.clear()
        chances = np.where(info["action_mask"], rng.random(info["action_mask"].shape), -1.0)
        info = env.step(chances.argmax(axis=1))[4]
    wall, busy = time.perf_counter() - start, time.process_time() - processor
    env.close()
    steps = spec.episodes * episode
    own = {} if batch is None else dict(batch.timings.own)
    split = {**own, REST: wall - sum(own.values())} if own else {}
    return {
        "steps_per_s": spec.num_envs * steps / wall,
        "steps_per_cpu_s": None if batch is None else spec.num_envs * steps / busy,
        "step_ms": 1e3 * wall / steps,
        "stages": [{"stage": k, "stage_ms": 1e3 * v / steps} for k, v in split.items()],
    }


if __name__ == "__main__":
    child = VectorSpec(**json.loads(sys.argv[1]))
    vector = gym.make_vec(ID, vectorization_mode="async", **_options(child))
    print(json.dumps(_drive(vector, child)))
