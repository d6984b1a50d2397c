"""Environments for training and validating policies."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from ms_slam_agents.batched_venv import BatchedVecEnv
from ms_slam_agents.curriculum import Staged, read_curriculum
from ms_slam_agents.evaluation import FixedEpisodes
from ms_slam_agents.options import Problem, Training, world_of
from ms_slam_agents.through_planner import ThroughPlanner
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import ms_slam_env  # registers the ids, in a worker process too
from ms_slam_env.env.reward import DEFAULT, DIVERGENCE_AND_ERROR, MAPPING
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.gym_ids import BATCHED_IDS, ENV_IDS, PERTURBED_ENV_IDS, TASK_IDS

VALIDATION_SEED = 1_000_000  # of the first validation episode; training draws from small seeds

_STARTS_A_SCENE = 32  # of environments in a batch, drawn when a scene is first entered


def make_env(
    args: Problem, split: str, seeds: Sequence[int] = (), environment: int = 0
) -> gym.Env[Any, Any]:
    """Build one environment; with ``seeds`` it plays only those episodes.

    A training environment follows the curriculum, if there is one; its number among the parallel
    environments selects its task.
    """
    if split == "train":
        args = world_of(args, environment)
    if multiprocessing.parent_process() is not None:  # in a worker Ctrl-C is the main's to answer
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.set_num_threads(1)

    def make(problem: Problem, more: Mapping[str, Any]) -> gym.Env[Any, Any]:
        options = problem_options(problem, split)
        env = gym.make(problem.env_id, disable_env_checker=True, **options, **more)
        through = problem.through if isinstance(problem, Training) else None
        return ThroughPlanner(env, through) if through else env

    path = getattr(args, "curriculum", None)
    if path and split == "train":
        return Staged(read_curriculum(path), args, make)
    return FixedEpisodes(make(args, {}), seeds) if seeds else make(args, {})


def problem_options(args: Problem, split: str) -> dict[str, Any]:
    """Options of ``gym.make`` for the episodes of a split."""
    few: dict[str, Any] = {"frames_per_action": args.frames_per_action}
    holder = args.embodiment or gym.spec(args.env_id).kwargs.get("embodiment", "")
    if args.frames_per_action is None:
        few = {}
    elif str(holder).startswith("arm"):
        few = {"arm": few}
    if args.image_size is not None:
        few["image_size"] = args.image_size
    if args.without:
        named = {} if args.reward == DEFAULT else {"name": args.reward}
        few["reward"] = named | dict.fromkeys(args.without, 0.0)
    elif args.reward != DEFAULT:
        few["reward"] = args.reward
    stays = getattr(args, "episodes_per_scene", 1)
    if split == "train" and stays > 1:
        few["episodes_per_scene"] = stays
    return {
        "max_episode_steps": args.episode_steps,
        "scene": args.scenes,
        "split": split,
        "num_scene_seeds": args.scene_seeds,
        "observation": args.observation,
        "frame_divergences": False,  # not used here
        **few,
        **env_options(args),
    }


def first_seed(seed: int, steps: int = 0) -> int:
    """Seed of the first parallel environment of a training; the others have the seeds after it.

    Far from those of other training seeds, and from those that this one used before ``steps``
    steps: with consecutive seeds two trainings would play nearly the same episodes.
    """
    return int(np.random.SeedSequence([seed, steps]).generate_state(1)[0]) >> 2


@contextmanager
def opened(venv: VecEnv) -> Iterator[VecEnv]:
    """Close the environments at the end, even if the process of one has died.

    Raises:
        RuntimeError: a process has died, instead of its connection error.
    """
    try:
        yield venv
    except (EOFError, ConnectionError):
        raise RuntimeError("the process of an environment has died; see the error above") from None
    finally:
        with suppress(EOFError, ConnectionError):
            venv.close()


def check_problem(args: Problem) -> None:
    """Refuse a problem for which no environment can be made.

    Raises:
        InputError: an unknown environment, or options that it refuses.
    """
    also = getattr(args, "also", ())
    if len(also) >= args.num_envs:
        raise InputError(
            f"{1 + len(also)} tasks to train in, the problem itself and --also {' '.join(also)}, "
            f"need as many environments: --num-envs {args.num_envs} is too few; --also without a "
            "name leaves the problem itself"
        )
    own = _spaces_in(args, "train")
    _spaces_in(args, "validation")
    for k, name in enumerate(also, 1):
        if _spaces_in(world_of(args, k), "train") != own:
            raise InputError(f"task {name!r} has other observations or actions than {args.env_id}")


def say_problem(args: Problem) -> None:
    """Print the problem at the start of a training."""
    also = getattr(args, "also", ())
    worlds = [world_of(args, k) for k in range(1 + len(also))]
    places = [
        f"{world.env_id} ({', '.join(world.scenes)}), reward {_reward_of(world)}"
        for world in worlds
    ]
    shares = [
        f"{place}, as --also {name} says" for name, place in zip(also, places[1:], strict=True)
    ]
    print("; and in ".join([f"trains in {places[0]}", *shares]), flush=True)


def _reward_of(problem: Problem) -> str:
    """Name of the reward; a policy trained for another one is easily compared by mistake."""
    if problem.reward != DEFAULT:
        return problem.reward
    by_id = dict.fromkeys((*ENV_IDS, *PERTURBED_ENV_IDS), DIVERGENCE_AND_ERROR)
    return (by_id | dict.fromkeys(TASK_IDS, MAPPING)).get(problem.env_id, "its own")


def _spaces_in(args: Problem, split: str) -> tuple[Any, Any]:
    """Observation and action space, from an environment made for this purpose."""
    try:
        env = make_env(args, split)
        if isinstance(env, Staged):
            env.check()
        env.close()
    except gym.error.UnregisteredEnv:
        raise unknown("environment", args.env_id, ms_slam_env.ENV_IDS) from None
    except gym.error.Error as error:
        raise InputError(f"environment {args.env_id!r} cannot be made: {error}") from None
    if env.observation_space.shape is None:
        raise InputError(
            f"observation {args.observation!r} has several parts, which no trainer takes; "
            "'pixels' has its images, smaller, in one vector"
        )
    if isinstance(env.action_space, gym.spaces.Box):
        raise InputError(
            f"the actions of {args.env_id!r} are continuous, which no trainer takes; "
            "docs/rl.md shows how to train with your own code"
        )
    return env.observation_space, env.action_space


def env_options(args: Problem) -> dict[str, Any]:
    """The environment options that a policy depends on, where they differ from the defaults."""
    step_rad = None if args.step_deg is None else math.radians(args.step_deg)
    options = {"embodiment": args.embodiment, "step_m": args.step_m, "step_rad": step_rad}
    return {name: value for name, value in options.items() if value is not None}


def make_venv(args: Problem, split: str, seeds: Sequence[int] = ()) -> VecEnv:
    """Build the parallel environments; the episodes ``seeds`` are dealt out to them in turn."""
    if split == "train" and isinstance(args, Training) and args.batched != "no":
        return _make_batch(args)
    num_envs = min(args.num_envs, len(seeds)) if seeds else args.num_envs

    def maker(rank: int) -> Callable[[], gym.Env[Any, Any]]:
        return lambda: make_env(args, split, seeds[rank::num_envs], rank)

    makers = [maker(rank) for rank in range(num_envs)]
    if num_envs == 1:
        return DummyVecEnv(makers)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # inherited by the workers
    return SubprocVecEnv(makers, start_method="spawn")


def _make_batch(args: Training) -> VecEnv:
    """Build training environments that step at once on a device."""
    batched_id = f"batched/{args.env_id}"
    if batched_id not in BATCHED_IDS:
        ids = [name.removeprefix("batched/") for name in BATCHED_IDS]
        raise unknown("environment in a batch", args.env_id, ids)
    options = problem_options(args, "train") | {"autoreset_mode": AutoresetMode.SAME_STEP}
    envs = gym.make_vec(
        batched_id, args.num_envs, device=args.batched, start_pool=_STARTS_A_SCENE, **options
    )
    return BatchedVecEnv(envs)
