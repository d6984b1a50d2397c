"""``ms-slam view``: an episode in the Rerun viewer, live or as a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym

import ms_slam_env
from ms_slam_env._runtime.command_line import parse
from ms_slam_env._runtime.interrupts import kept
from ms_slam_env._runtime.output_files import check_out_file
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.config import Checked, bounded, chosen, free_options
from ms_slam_env.env.planners import check_planner, make_planner, planner_observation

if TYPE_CHECKING:
    from ms_slam_env.env import ActiveSlamEnv


@dataclass(frozen=True)
class Args(Checked):
    """Look inside an episode with the Rerun viewer

    Camera, images, map, true and estimated path, arm, divergences against M, reward terms,
    candidates and the planner's goal, step by step. Opens a window unless --save is given.
    """

    planner: str = "nbv"
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    env_id: str = chosen("MSActiveSLAM-FreeCamera-v0", *ms_slam_env.ENV_IDS, *ms_slam_env.TASK_IDS)
    """Environment."""
    scene: str = "living_room"
    """Name of a scene, or a mesh file."""
    scene_seed: int = bounded(2000, 0, 2**31)
    """Seed of the scene."""
    seed: int = bounded(0, 0, 2**31)
    """Seed of start pose, sensor noise and planner."""
    steps: int = bounded(100, 1, 1_000_000)
    """Length of the episode."""
    options: tuple[str, ...] = ()
    """Further options of the environment, as name=value."""
    save: Path | None = None
    """File (.rrd) to write instead of opening a window; `rerun FILE` shows it."""


def main(arguments: Sequence[str]) -> int:
    """Play an episode and show it; return the exit code."""
    args = parse(Args, arguments, "ms-slam view")
    check_planner(args.planner)
    if args.save is not None:
        check_out_file(args.save)
    env = gym.make(
        args.env_id,
        max_episode_steps=args.steps,
        disable_env_checker=True,
        scene=args.scene,
        scene_seed=args.scene_seed,
        observation=planner_observation(args.planner),
        **free_options(args.options, ("scene", "scene_seed", "observation")),
    )
    try:
        _play(env, args)
    finally:
        env.close()
    if args.save is not None:
        print(f"{args.save}: show it with `rerun {args.save}`")
    return 0


def _play(env: gym.Env[Any, Any], args: Args) -> None:
    from ms_slam_env.env.rerun_view import EpisodeView

    world = cast("ActiveSlamEnv", env.unwrapped)
    planner = make_planner(args.planner, world, args.seed)
    observation, info = env.reset(seed=args.seed)
    planner.reset()
    view = EpisodeView(world, args.save)
    try:
        with kept("the steps so far are shown"):
            view.log(planner)
            for _ in Bar(range(args.steps), "steps", unit="step"):
                action = planner.act(observation, planner.known(info))
                observation, _, terminated, truncated, info = env.step(action)
                view.log(planner)
                if terminated or truncated:
                    break
    finally:
        view.close()
