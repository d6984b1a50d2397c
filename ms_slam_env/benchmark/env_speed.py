"""Decisions a second of the environment, and where the time of a decision goes.

``ms-slam experiment env-speed`` writes ``env_speed.json`` and prints a table.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np

from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.config import check_range
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.observations import OBSERVATIONS
from ms_slam_env.errors import unknown
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.report.tables import markdown_table

PROGRAM = "ms-slam experiment env-speed"
ORDER = ("ik", "physics", "move", "mask", "render", "slam", "divergence", "coverage", "lookahead")
"""Order of the stages in the table; others follow."""
REST = "rest"
WITHOUT_FRAMES = ("free", "fixed-translation")
"""Embodiments that bring one frame a step, whatever ``frames_per_action`` says."""


@dataclass(frozen=True)
class Arguments:
    """Decisions a second with random permitted actions, and milliseconds a step in each stage.

    The clock runs during ``env.step`` alone; resets are not counted. Processor time is what a step
    would take on a core of its own, where the measured time suffers from a busy machine.
    """

    embodiments: tuple[str, ...] = ("arm", "arm-kinematic", "free")
    """What holds the camera."""
    frames_per_action: tuple[int | None, ...] = (1, None)
    """Frames of a motion of an arm; None for as many as arrive while it moves."""
    observations: tuple[str, ...] = tuple(OBSERVATIONS)
    """Observation variants."""
    scene: str = "living_room"
    """A scene's name, or a mesh file."""
    scene_seed: int = 2000
    """Of a procedural scene."""
    image_size: str = "160x120"
    """Of the camera, width x height."""
    seconds: float = 15
    """Length of each measurement."""
    warm_up: int = 20
    """Steps before it: the first ones compile or load kernels."""
    out: Path = Path("results/env_speed")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse unknown choices and a measurement of no length."""
        check_range(self, "seconds", 0.01, 3600)
        check_range(self, "warm_up", 0, 10_000)
        for names, kind, choices in (
            (self.embodiments, "embodiment", EMBODIMENTS),
            (self.observations, "observation", OBSERVATIONS),
        ):
            for name in names:
                if name not in choices:
                    raise unknown(kind, name, choices)


@dataclass(frozen=True)
class Case:
    """One measurement."""

    embodiment: str
    frames_per_action: int | None
    observation: str


def cases(args: Arguments) -> list[Case]:
    """Every combination that makes a difference."""
    return [
        Case(embodiment, frames, observation)
        for embodiment in args.embodiments
        for frames in ((1,) if embodiment in WITHOUT_FRAMES else args.frames_per_action)
        for observation in args.observations
    ]


def measure(args: Arguments, case: Case) -> dict[str, Any]:
    """Speed and split of one case.

    Returns:
        ``steps``; ``steps_per_s``; ``frames_per_step``; ``step_ms`` (mean), ``step_ms_95`` (95th
        percentile); ``processor_ms`` (mean, of all threads); ``split_ms``: mean milliseconds a
        step that each stage took itself, without those nested in it, and ``rest``.
    """
    has_arm = case.embodiment not in WITHOUT_FRAMES
    env = gym.make(
        "MSActiveSLAM-v0",
        embodiment=case.embodiment,
        arm={"frames_per_action": case.frames_per_action} if has_arm else {},
        scene=args.scene,
        scene_seed=args.scene_seed,
        image_size=args.image_size,
        observation=case.observation,
        disable_env_checker=True,
    )
    try:
        return _drive(env, args)
    finally:
        env.close()


def _drive(env: gym.Env[Any, Any], args: Arguments) -> dict[str, Any]:
    world = cast(ActiveSlamEnv, env.unwrapped)
    rng = np.random.default_rng(0)
    _, info = env.reset(seed=0)
    durations: list[float] = []
    split: dict[str, float] = {}
    frames, busy, begin = 0, 0.0, np.inf
    for step in range(1_000_000_000):
        if step == args.warm_up:
            begin = time.perf_counter()
        action = rng.choice(np.flatnonzero(info["action_mask"]))
        before = len(world.episode.timestamps)
        world.timings.clear()  # what happens between steps, such as a reset, is not counted
        processor, start = time.process_time(), time.perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        now = time.perf_counter()
        if step >= args.warm_up:
            durations.append(now - start)
            busy += time.process_time() - processor
            frames += len(world.episode.timestamps) - before
            for name, seconds in world.timings.own.items():
                split[name] = split.get(name, 0.0) + seconds
            if now - begin > args.seconds:
                break
        if terminated or truncated:
            _, info = env.reset()
    total = float(np.sum(durations))
    split[REST] = total - sum(split.values())
    count = len(durations)
    return {
        "steps": count,
        "steps_per_s": count / total,
        "frames_per_step": frames / count,
        "step_ms": 1e3 * total / count,
        "processor_ms": 1e3 * busy / count,
        "step_ms_95": 1e3 * float(np.percentile(durations, 95)),
        "split_ms": {name: 1e3 * seconds / count for name, seconds in split.items()},
    }


def as_table(results: dict[Case, dict[str, Any]]) -> str:
    """Markdown: one line a case, one column a stage that took time in any."""
    seen = {stage for result in results.values() for stage in result["split_ms"]}
    stages = [*(s for s in ORDER if s in seen), *sorted(seen - {*ORDER, REST}), REST]
    body = [
        [
            case.embodiment,
            f"{result['frames_per_step']:.1f}",
            case.observation,
            f"{result['steps_per_s']:.1f}",
            f"{result['processor_ms']:.1f}",
            *(f"{result['split_ms'].get(stage, 0):.2f}" for stage in stages),
        ]
        for case, result in results.items()
    ]
    headings = ["embodiment", "frames a step", "observation", "steps/s", "processor [ms]"]
    return markdown_table([*headings, *(f"{stage} [ms]" for stage in stages)], body)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every case; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    results = {}
    for case in cases(args):
        results[case] = measure(args, case)
        print(f"{case}: {results[case]['steps_per_s']:.1f} steps/s", file=sys.stderr)
    rows = [{**vars(case), **result} for case, result in results.items()]
    write_json(args.out / "env_speed.json", {"provenance": provenance(), "results": rows})
    print(as_table(results))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
