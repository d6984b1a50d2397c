"""A soak: many steps of every environment, in which nothing becomes NaN and no memory is lost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from ms_slam_env import ENV_IDS, PERTURBED_ENV_IDS, TASK_IDS
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import unknown
from ms_slam_env.experiments.harness.experiment import Experiment
from ms_slam_env.metrics.cost.meter import resident_mb
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table, finished, make_table

IDS = (*ENV_IDS, *TASK_IDS, *PERTURBED_ENV_IDS)

ARM_SHARE = 40
"""Steps of other cameras for one of the arm, each ten frames and the physics of a motion."""


@dataclass(frozen=True)
class SoakSpec:
    """One piece: so many steps of one environment, in a process of its own."""

    env_id: str
    piece: int
    steps: int
    image_size: str


@dataclass(frozen=True)
class Soak(Experiment, Checked):
    """Steps of every environment with random permitted actions

    Every number in observation, reward and info is looked at. Memory is that of the process after
    each step: its peak in the second half of a piece over that in the first, which is the warm-up.
    Pieces are finished one by one, and those that are there already are not run again. A step of
    the arm is ten frames and its physics: pieces of such an environment have a fortieth of the
    steps. A million steps are 1,300 for each environment with the arm and 52,000 for each of the
    others.
    """

    env_ids: tuple[str, ...] = IDS
    """Environments; those with the arm have a fortieth of the steps of the others."""
    steps: int = bounded(1_000_000, 1, 10**9)
    """Of all environments together, rounded up to whole pieces of each."""
    piece_steps: int = bounded(13_000, 2, 10**7)
    """Steps of a piece; a fortieth with the arm, at least 2."""
    image_size: str = "80x60"
    """Of the camera, width x height."""

    unit = "pieces"
    workers = 1
    fresh_process = True

    def specs(self) -> list[SoakSpec]:
        """Pieces of all environments in turn."""
        for env_id in self.env_ids:
            if env_id not in IDS:
                raise unknown("environment", env_id, IDS)
        arm_steps = max(2, self.piece_steps // ARM_SHARE)
        steps = {one: arm_steps if has_arm(one) else self.piece_steps for one in self.env_ids}
        pieces = -(-self.steps // sum(steps.values()))
        return [
            SoakSpec(env_id, piece, steps[env_id], self.image_size)
            for piece in range(pieces)
            for env_id in steps
        ]

    @staticmethod
    def run(spec: SoakSpec) -> dict[str, Any]:
        """Take the steps of a piece, in a scene and with actions of its own."""
        env = gym.make(spec.env_id, scene_seed=spec.piece, image_size=spec.image_size)
        memory_mb: list[float] = []
        bad: list[str] = []
        episodes = 0
        try:
            for info, is_first, *numbers in _steps(env, spec):
                episodes += is_first
                memory_mb.append(resident_mb() or np.nan)
                covariance = info["pose_covariance"]  # infinite where SLAM gave none, never NaN
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
        """One line an environment."""
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


def has_arm(env_id: str) -> bool:
    """Whether an arm moves the camera of this environment."""
    return bool(gym.spec(env_id).kwargs["embodiment"] == "arm")


def _steps(env: gym.Env[Any, Any], spec: SoakSpec) -> Iterator[tuple[Any, ...]]:
    """Info, whether an episode begins, observation and reward, of so many steps."""
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
    """Places in nested mappings, sequences and arrays that hold NaN or infinity."""
    if isinstance(value, Mapping):
        for name, one in value.items():
            yield from not_finite(one, f"{where}.{name}" if where else str(name))
    elif isinstance(value, (list, tuple)):
        for k, one in enumerate(value):
            yield from not_finite(one, f"{where}[{k}]")
    elif np.asarray(value).dtype.kind == "f" and not np.isfinite(value).all():
        yield where
