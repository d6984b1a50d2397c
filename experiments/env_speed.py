"""Measure the environment's steps per second, and the time of each stage of a step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import gymnasium as gym
import numpy as np

from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.config import Checked, bounded
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.registry import OBSERVATIONS
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table

ORDER = ("ik", "physics", "move", "mask", "render", "slam", "divergence", "coverage", "lookahead")
"""Order of the stages in the table; others follow."""
REST = "rest"
WITHOUT_FRAMES = ("free", "fixed-translation")
"""Embodiments with one frame per step, regardless of ``frames_per_action``."""


@dataclass(frozen=True)
class EnvSpeedSpec:
    """One measurement; see :class:`EnvSpeed` for the fields."""

    embodiment: str
    frames_per_action: int | None
    observation: str
    scene: str = "living_room"
    scene_seed: int = 2000
    image_size: str = "160x120"
    seconds: float = 15
    warm_up: int = 20


@dataclass(frozen=True)
class EnvSpeed(Experiment, Checked):
    """Decisions a second with random permitted actions, and where their time goes

    Only ``env.step`` is timed; resets do not count. Unlike the time by the clock, processor time
    does not depend on other programs on the machine.
    """

    embodiments: tuple[str, ...] = ("arm", "arm-kinematic", "free")
    """Embodiments of the camera."""
    frames_per_action: tuple[int | None, ...] = (1, None)
    """Frames per motion of an arm; None for all frames that arrive while it moves."""
    observations: tuple[str, ...] = tuple(OBSERVATIONS)
    """Observation variants."""
    scene: str = "living_room"
    """A scene's name, or a mesh file."""
    scene_seed: int = 2000
    """Seed of a procedural scene."""
    image_size: str = "160x120"
    """Image size, width x height."""
    seconds: float = bounded(15.0, 0.01, 3600)
    """Length of each measurement."""
    warm_up: int = bounded(20, 0, 10_000)
    """Steps before the measurement, which compile or load kernels."""

    unit = "measurements"
    workers = 1

    def specs(self) -> list[EnvSpeedSpec]:
        """Every distinct combination."""
        check_each("embodiment", self.embodiments, EMBODIMENTS)
        check_each("observation", self.observations, OBSERVATIONS)
        return [
            spec
            for embodiment in self.embodiments
            for spec in self.each(
                EnvSpeedSpec,
                embodiment=(embodiment,),
                frames_per_action=(1,) if embodiment in WITHOUT_FRAMES else self.frames_per_action,
                observation=self.observations,
            )
        ]

    @staticmethod
    def run(spec: EnvSpeedSpec) -> dict[str, Any]:
        """Speed of one case, and time of each stage without nested ones."""
        has_arm = spec.embodiment not in WITHOUT_FRAMES
        env = gym.make(
            "MSActiveSLAM-v0",
            embodiment=spec.embodiment,
            arm={"frames_per_action": spec.frames_per_action} if has_arm else {},
            scene=spec.scene,
            scene_seed=spec.scene_seed,
            image_size=spec.image_size,
            observation=spec.observation,
            disable_env_checker=True,
        )
        try:
            return _drive(env, spec.seconds, spec.warm_up)
        finally:
            env.close()

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per case, one column per stage that took time in any case."""
        lines, seen = [], set()
        for row in finished(rows):
            times = {one["stage"]: one["stage_ms"] for one in row["result"]["stages"]}
            figures = {k: v for k, v in row["result"].items() if k != "stages"}
            case = {key: row["spec"][key] for key in ("embodiment", "observation")}
            lines.append({**case, **figures, **{f"{key}_ms": ms for key, ms in times.items()}})
            seen |= set(times)
        order = [*(s for s in ORDER if s in seen), *sorted(seen - {*ORDER, REST}), REST]
        columns: list[Column | str] = [
            *("embodiment", "frames_per_step", "observation", "steps_per_s", "step_cpu_ms"),
            *(Column(f"{stage}_ms", "stage_ms", stage) for stage in order),
        ]
        return [make_table(columns, lines, note="Stages: mean time a step, by the clock.")]


def _drive(env: gym.Env[Any, Any], length_s: float, warm_up: int) -> dict[str, Any]:
    """Take random steps for ``length_s`` seconds, after ``warm_up`` steps."""
    world = cast(ActiveSlamEnv, env.unwrapped)
    rng = np.random.default_rng(0)
    _, info = env.reset(seed=0)
    durations: list[float] = []
    split: dict[str, float] = {}
    frames, busy, begin = 0, 0.0, np.inf
    for step in range(1_000_000_000):
        if step == warm_up:
            begin = time.perf_counter()
        action = rng.choice(np.flatnonzero(info["action_mask"]))
        before = len(world.episode.timestamps)
        world.timings.clear()  # time between steps, such as a reset, does not count
        processor, start = time.process_time(), time.perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        now = time.perf_counter()
        if step >= warm_up:
            durations.append(now - start)
            busy += time.process_time() - processor
            frames += len(world.episode.timestamps) - before
            for name, seconds in world.timings.own.items():
                split[name] = split.get(name, 0.0) + seconds
            if now - begin > length_s:
                break
        if terminated or truncated:
            _, info = env.reset()
    total = float(np.sum(durations))
    split[REST] = total - sum(split.values())
    count = len(durations)
    return {
        "measured_steps": count,
        "steps_per_s": count / total,
        "frames_per_step": frames / count,
        "step_ms": 1e3 * total / count,
        "step_ms_p95": 1e3 * float(np.percentile(durations, 95)),
        "step_cpu_ms": 1e3 * busy / count,
        "stages": [{"stage": k, "stage_ms": 1e3 * v / count} for k, v in split.items()],
    }
