"""Steps a second of the environment, and where the time goes.

``python -m ms_slam_env.benchmark.env_speed`` writes ``env_speed.json`` and prints a table.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
from gymnasium.utils.performance import benchmark_step

from ms_slam_env.benchmark.command_line import exit_code, parse
from ms_slam_env.benchmark.provenance import provenance
from ms_slam_env.benchmark.records import write_json
from ms_slam_env.benchmark.table import markdown_table
from ms_slam_env.config import check_range
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.observations import OBSERVATIONS

PROGRAM = "python -m ms_slam_env.benchmark.env_speed"
WARM_UP_STEPS = 20  # the first steps compile or load kernels and build the scene


@dataclass(frozen=True)
class Arguments:
    """Steps a second by ``gymnasium.utils.performance.benchmark_step``, for each observation."""

    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    """The environment."""
    scene: str = "living_room"
    """A scene's name, or a mesh file."""
    scene_seed: int = 2000
    """Of a procedural scene."""
    image_size: str = "160x120"
    """Of the camera, width x height."""
    seconds: int = 15
    """Length of each measurement."""
    out: Path = Path("results/env_speed")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse a measurement of no length."""
        check_range(self, "seconds", 1, 3600)


def measure(args: Arguments, observation: str) -> dict[str, Any]:
    """Steps a second and mean milliseconds a call of each stage, for one observation variant."""
    env = gym.make(
        args.env_id,
        scene=args.scene,
        scene_seed=args.scene_seed,
        image_size=args.image_size,
        observation=observation,
        disable_env_checker=True,
    )
    env.reset(seed=0)
    for _ in range(WARM_UP_STEPS):
        env.step(env.action_space.sample())
    world = cast(ActiveSlamEnv, env.unwrapped)
    world.timings.clear()
    steps_per_s = benchmark_step(env, args.seconds, seed=0)
    return {"steps_per_s": steps_per_s, "stages_ms": world.timings.mean_ms()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every observation variant; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    results = {name: measure(args, name) for name in OBSERVATIONS}
    stages = list(results["lookahead"]["stages_ms"])
    table = markdown_table(
        ["observation", "steps/s", *(f"{stage} [ms]" for stage in stages)],
        [
            [
                name,
                f"{result['steps_per_s']:.1f}",
                *(f"{result['stages_ms'].get(stage, 0):.2f}" for stage in stages),
            ]
            for name, result in results.items()
        ],
    )
    write_json(
        args.out / "env_speed.json",
        {"provenance": provenance(), "results": results},
    )
    print(table)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
