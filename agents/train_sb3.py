"""Train a camera-motion policy with PPO (Stable-Baselines3), with or without action masks.

    ms-slam train sb3 --out runs/ppo --minutes 60

Top to bottom: environments, training; the options are in ``options.py``, what happens between
updates in ``supervisor.py``. Writes into ``out``: ``latest.safetensors`` (to resume from) and
``best.safetensors`` (highest validation return), both fit for ``ms_slam_agents.policy`` and the
planners, the learning curve with random walk, standing still and the greedy planner on the same
validation episodes as references (``results.json``, ``table.md``, a figure), and logs for
TensorBoard.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import gymnasium as gym
import torch
from ms_slam_agents import convert_sb3
from ms_slam_agents.evaluation import FixedEpisodes, references
from ms_slam_agents.learning_curve import Curve, read_curve
from ms_slam_agents.options import (
    KEPT,
    Args,
    Problem,
    check_kept,
    check_new,
    check_steps_left,
    parse_for_task,
    resumed,
)
from ms_slam_agents.policy_file import PolicyFile, read_policy
from ms_slam_agents.sb3_state import ALGORITHMS, Model, restore, whole_batches
from ms_slam_agents.supervisor import LATEST, Supervisor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
)

import ms_slam_env  # registers the ids, in a worker process too
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.interrupts import kept
from ms_slam_env.report.results import RESULTS

VALIDATION_SEED = 1_000_000  # of the first validation episode; training draws from small seeds


# -- Environments ------------------------------------------------------------------------------


def make_env(args: Problem, split: str, seeds: Sequence[int]) -> gym.Env[Any, Any]:
    """Build one environment; with ``seeds`` it plays those episodes only."""
    if multiprocessing.parent_process() is not None:  # in a worker Ctrl-C is the main's to answer
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.set_num_threads(1)
    env = gym.make(args.env_id, disable_env_checker=True, **problem_options(args, split))
    return FixedEpisodes(env, seeds) if seeds else env


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
    return {
        "max_episode_steps": args.episode_steps,
        "scene": args.scenes,
        "split": split,
        "num_scene_seeds": args.scene_seeds,
        "observation": args.observation,
        "frame_divergences": False,  # nobody reads them here
        **few,
        **env_options(args),
    }


def check_problem(args: Problem) -> None:
    """Refuse what no environment can be made of.

    Raises:
        InputError: an unknown environment, or options that it refuses.
    """
    try:
        for split in ("train", "validation"):
            make_env(args, split, ()).close()
    except gym.error.UnregisteredEnv:
        raise unknown("environment", args.env_id, ms_slam_env.ENV_IDS) from None
    except gym.error.Error as error:
        raise InputError(f"environment {args.env_id!r} cannot be made: {error}") from None


def env_options(args: Problem) -> dict[str, Any]:
    """Options of the environment that a policy depends on, where not the environment's own."""
    step_rad = None if args.step_deg is None else math.radians(args.step_deg)
    options = {"embodiment": args.embodiment, "step_m": args.step_m, "step_rad": step_rad}
    return {name: value for name, value in options.items() if value is not None}


def make_venv(args: Problem, split: str, seeds: Sequence[int] = ()) -> VecEnv:
    """Build the parallel environments; the episodes ``seeds`` are dealt out to them in turn."""
    num_envs = min(args.num_envs, len(seeds)) if seeds else args.num_envs

    def maker(rank: int) -> Callable[[], gym.Env[Any, Any]]:
        return lambda: make_env(args, split, seeds[rank::num_envs])

    makers = [maker(rank) for rank in range(num_envs)]
    if num_envs == 1:
        return DummyVecEnv(makers)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # inherited by the workers
    return SubprocVecEnv(makers, start_method="spawn")


# -- Training ----------------------------------------------------------------------------------


def make_model(args: Args, venv: VecEnv, file: PolicyFile | None) -> Model:
    """Build the model on normalised environments, new or as it stands in ``file``."""
    normalize = VecNormalize(VecMonitor(venv), gamma=args.gamma)
    done = file.metadata.timesteps if file else 0
    n_steps = rollout_steps(args, venv.num_envs, done)
    model = ALGORITHMS[args.algorithm](
        "MlpPolicy",
        normalize,
        learning_rate=args.learning_rate,
        n_steps=n_steps,
        batch_size=whole_batches(n_steps * venv.num_envs, args.batch_size),
        n_epochs=args.n_epochs,
        gamma=args.gamma,
        gae_lambda=args.gae_lambda,
        ent_coef=args.ent_coef,
        clip_range=args.clip_range,
        policy_kwargs={"net_arch": [args.hidden, args.hidden]},
        tensorboard_log=str(args.out / "tensorboard"),
        seed=args.seed + done,  # a resumed run goes on with new episodes
        device="cpu",
    )
    if file:
        restore(model, file)
    elif args.init:
        restore(model, begun(args))
    return model


def begun(args: Args) -> PolicyFile:
    """The policy to begin with, as if it had no steps.

    Raises:
        InputError: no policy, or one of another network or problem.
    """
    assert args.init
    file = read_policy(args.init).without_optimizer()
    known = file.metadata
    for name, own in (("env_id", args.env_id), ("observation", args.observation)):
        if getattr(known, name) != own:
            raise InputError(f"{args.init} is for {name} {getattr(known, name)!r}, not {own!r}")
    if tuple(known.hidden) != (args.hidden, args.hidden):
        raise InputError(f"{args.init} has layers of {known.hidden}: give --hidden that")
    return replace(file, metadata=replace(file.metadata, timesteps=0, epochs=0))


def rollout_steps(args: Args, num_envs: int, done: int) -> int:
    """Steps of each environment between updates: no more than the budget has left, at least 2."""
    left = math.ceil((args.total_timesteps - done) / num_envs)
    return max(2, min(args.n_steps, left))


def load_run(args: Args) -> PolicyFile | None:
    """What there is to resume; None for a new run.

    Raises:
        InputError: nothing to resume from, nothing left to do, another network or problem, or a
            new run where there is one already.
    """
    path = args.out / LATEST
    if not args.resume:
        check_new(args.out, LATEST)
        return None
    file = read_policy(path)
    saved = resumed(args, file.metadata.options)
    check_kept(path, asdict(saved), args, KEPT)
    check_steps_left(path, file.metadata.timesteps, args.total_timesteps)
    if file.metadata.epochs and not file.can_resume:
        raise InputError(f"{path} has no state of the optimiser to resume from")
    for name, value in asdict(args).items():
        if value != getattr(saved, name):
            print(f"{name} is {value!r} from now on, {getattr(saved, name)!r} so far")
    return file


def load_curve(args: Args, validation: VecEnv) -> Curve:
    """Return the learning curve so far: that of the run to resume, or references and no points.

    Raises:
        InputError: the run to resume was evaluated on another number of episodes.
    """
    path = args.out / RESULTS
    if args.resume and path.is_file():
        curve = read_curve(path)
        if curve.episodes != args.eval_episodes:
            raise InputError(
                f"{path} has points of eval_episodes = {curve.episodes} each, "
                f"not {args.eval_episodes}"
            )
        return curve
    known = references(validation, args.eval_episodes) if args.references else {}
    return Curve(args.eval_episodes, known)


def train(args: Args) -> int:
    """Train as ``args`` say; return the exit status, 130 after an interrupt.

    Raises:
        InputError: bad options, or nothing to train.
        RuntimeError: time was up before the first update.
    """
    torch.set_num_threads(1)
    file = load_run(args)
    if args.init and file is None:
        begun(args)  # refused before anything is written
    check_problem(args)  # here, not in a worker process
    args.out.mkdir(parents=True, exist_ok=True)
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
    validation = make_venv(args, "validation", seeds)
    training = make_venv(args, "train")
    handlers: dict[int, Any] = {}
    try:
        model = make_model(args, training, file)
        minutes = file.metadata.minutes if file else 0.0
        curve = load_curve(args, validation)
        supervisor = Supervisor(args, env_options(args), validation, curve, minutes)

        def interrupt(number: int, _: object) -> None:
            signal.signal(number, handlers[number])  # a second one ends at once
            supervisor.stop(f"interrupted by {signal.Signals(number).name}")

        for number in (signal.SIGINT, signal.SIGTERM):
            handlers[number] = signal.signal(number, interrupt)
        with kept(f"what was trained before the last update is kept in {args.out}"), supervisor:
            model.learn(
                max(0, args.total_timesteps - model.num_timesteps),
                callback=supervisor,
                tb_log_name=args.algorithm,
                reset_num_timesteps=not args.resume,
            )
    finally:
        for caught, handler in handlers.items():
            signal.signal(caught, handler)
        training.close()
        validation.close()
    return report(supervisor)


def report(supervisor: Supervisor) -> int:
    """Say how training ended; return the exit status.

    Raises:
        RuntimeError: time was up before the first update.
    """
    args, steps = supervisor.args, supervisor.num_timesteps
    ended = supervisor.stop_reason or "done"
    is_interrupted = ended.startswith("interrupt")
    if not supervisor.has_learnt and not is_interrupted:
        raise RuntimeError(
            f"{ended}, but nothing was learnt: {supervisor.unlearnt_steps} steps are less than a "
            f"batch of {args.batch_size}; give more --minutes or a smaller --batch-size"
        )
    learnt = "" if supervisor.has_learnt else "; nothing was learnt in this run"
    if supervisor.unlearnt_steps:
        learnt += f"; the last {supervisor.unlearnt_steps} steps, less than a batch, are not in it"
    print(f"{ended}: {steps} steps, policy in {args.out}{learnt}")
    return 130 if is_interrupted else 0


def parse_options(argv: Sequence[str] | None) -> Args:
    """The options; of a run to resume, those that it had for what the command line does not say.

    Raises:
        InputError: bad options, or nothing to resume from.
    """
    prog = "ms-slam train"
    words = list(sys.argv[1:] if argv is None else argv)
    given = parse_for_task(Args, words, prog, "sb3")
    if not given.resume:
        return given
    saved = resumed(given, read_policy(given.out / LATEST).metadata.options)
    return parse(Args, words, prog, default=saved)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, 1 if nothing was learnt, 2, 130."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["convert"]:
        return exit_code(lambda: convert_sb3.main(words[1:]), "ms-slam train sb3 convert")
    return exit_code(lambda: train(parse_options(words)), "ms-slam train")


if __name__ == "__main__":
    sys.exit(main())
