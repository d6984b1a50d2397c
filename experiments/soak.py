"""Soak test: many steps of every environment, without NaN values and memory leaks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from ms_slam_env import ENV_IDS, PERTURBED_ENV_IDS, TASK_IDS
from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.config import Checked, bounded
from ms_slam_env.metrics.cost.meter import resident_mb
from ms_slam_env.report.tables import Row, Table, finished, make_table

IDS = (*ENV_IDS, *TASK_IDS, *PERTURBED_ENV_IDS)

PLAIN_IDS = ("MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-FixedTranslation-v0")
"""The two environments with the cheapest steps: no disturbances, and one frame per motion."""

SHARE, ARM_SHARE = 10, 250
"""Steps of a plain environment for each step of another one, and for each step of the arm, which
takes ten frames and the physics of a motion."""


@dataclass(frozen=True)
class SoakSpec:
    """One piece: a number of steps of one environment, in a separate process."""

    env_id: str
    piece: int
    steps: int
    image_size: str


@dataclass(frozen=True)
class Soak(Experiment, Checked):
    """Steps of every environment with random permitted actions

    Checks every number in observation, reward and info. Growth of memory is the peak of the
    process's memory in the second half of a piece over that in the first half, which is the
    warm-up. Pieces finish one by one, and finished pieces are not run again. Most steps are of the
    two environments with the cheapest steps: of a million steps, 272,000 of each of these, 27,200
    of each other environment without the arm, and 1,088 of each with the arm. The latter are one
    piece, since a shorter warm-up would end before every scene was seen.
    """

    env_ids: tuple[str, ...] = IDS
    """Environments."""
    steps: int = bounded(1_000_000, 1, 10**9)
    """Steps of all environments together, rounded up to whole pieces of each."""
    piece_steps: int = bounded(68_000, 2, 10**7)
    """Steps of a piece of the free camera; a tenth with disturbances or a task, 1/250 for the arm
    (which has a single piece); at least 2."""
    image_sizes: tuple[str, ...] = ("80x60",)
    """Image sizes, width x height, which environments and their pieces use in turn."""

    unit = "pieces"
    workers = 1
    fresh_process = True

    def specs(self) -> list[SoakSpec]:
        """Pieces of all environments in turn, and one of each with the arm."""
        check_each("environment", self.env_ids, IDS)
        steps = {one: max(2, self.piece_steps // share(one)) for one in self.env_ids}
        pieces = -(-self.steps // sum(steps.values()))
        arms = [one for one in steps if share(one) == ARM_SHARE]
        found = [
            *(
                (one, piece, steps[one])
                for piece in range(pieces)
                for one in steps
                if one not in arms
            ),
            *((one, 0, pieces * steps[one]) for one in arms),
        ]
        sizes = self.image_sizes
        return [
            SoakSpec(one, piece, count, sizes[(piece + list(steps).index(one)) % len(sizes)])
            for one, piece, count in found
        ]

    @staticmethod
    def run(spec: SoakSpec) -> dict[str, Any]:
        """Take the steps of a piece, with its own scene and actions."""
        env = gym.make(spec.env_id, scene_seed=spec.piece, image_size=spec.image_size)
        memory_mb: list[float] = []
        bad: list[str] = []
        episodes = 0
        try:
            for info, is_first, *numbers in _steps(env, spec):
                episodes += is_first
                memory_mb.append(resident_mb() or np.nan)
                covariance = info["pose_covariance"]  # infinite if SLAM gave none, never NaN
                known = {
                    **info,
                    "pose_covariance": np.where(np.isposinf(covariance), 0, covariance),
                }
                bad += not_finite({"info": known, "step": numbers})
        finally:
            env.close()
        half = len(memory_mb) // 2
        first, second = max(memory_mb[:half]), max(memory_mb[half:])
        return {
            "measured_steps": len(memory_mb),
            "soak_episodes": episodes,
            "not_finite": len(bad),
            "not_finite_first": bad[0] if bad else "",
            "mem_process_mb": second,
            "mem_growth": second / first - 1.0,
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per environment."""
        done = list(finished(rows))
        lines = []
        for env_id in dict.fromkeys(row["spec"]["env_id"] for row in done):
            own = [row["result"] for row in done if row["spec"]["env_id"] == env_id]
            totals = {key: sum(one[key] for one in own) for key in _SUMMED}
            worst = {key: max(one[key] for one in own) for key in ("mem_process_mb", "mem_growth")}
            lines.append({"env_id": env_id, **totals, **worst})
        sums = {key: sum(line[key] for line in lines) for key in _SUMMED}
        note = f"{sums['measured_steps']} steps in all. Memory is that of the worst piece."
        return [make_table(["env_id", *_SUMMED, "mem_process_mb", "mem_growth"], lines, note=note)]


_SUMMED = ("measured_steps", "soak_episodes", "not_finite")


def share(env_id: str) -> int:
    """Number of steps of the free camera for each step of this environment."""
    if env_id in PLAIN_IDS:
        return 1
    return ARM_SHARE if gym.spec(env_id).kwargs["embodiment"] == "arm" else SHARE


def _steps(env: gym.Env[Any, Any], spec: SoakSpec) -> Iterator[tuple[Any, ...]]:
    """Info, whether an episode begins, observation and reward, for each step of the piece."""
    observation, info = env.reset(seed=spec.piece)
    env.action_space.seed(spec.piece)
    begins = True
    for _ in range(spec.steps):
        action = env.action_space.sample(mask=info["action_mask"])
        observation, reward, terminated, truncated, info = env.step(action)
        yield info, begins, observation, reward
        begins = terminated or truncated
        if begins:
            observation, info = env.reset()


def not_finite(value: Any, where: str = "") -> Iterator[str]:
    """Names of entries in nested mappings, sequences and arrays that are NaN or infinite."""
    if isinstance(value, Mapping):
        for name, one in value.items():
            yield from not_finite(one, f"{where}.{name}" if where else str(name))
    elif isinstance(value, (list, tuple)):
        for k, one in enumerate(value):
            yield from not_finite(one, f"{where}[{k}]")
    elif np.asarray(value).dtype.kind == "f" and not np.isfinite(value).all():
        yield where
