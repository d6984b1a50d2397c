"""Train a camera-motion policy with Stable-Baselines3: PPO with or without action masks, or DQN.

    ms-slam train sb3 --out runs/ppo --minutes 60

The options are in ``trainers.py``, what happens between updates in ``supervisor.py``. Writes into
``out``: ``latest.safetensors`` (to resume from) and ``best.safetensors`` (highest validation
return), both fit for ``ms_slam_agents.policy`` and the planners, the learning curve with random
walk, standing still and the greedy planner on the same validation episodes as references
(``results.json``, ``table.md``, a figure), and logs for TensorBoard.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import torch
from gymnasium.spaces import Discrete
from ms_slam_agents.environments import (
    VALIDATION_SEED,
    check_problem,
    first_seed,
    make_venv,
    opened,
    say_problem,
)
from ms_slam_agents.policy import action_parts
from ms_slam_agents.policy_file import PolicyFile
from ms_slam_agents.sb3_state import ALGORITHMS, Model, restore, whole_batches
from ms_slam_agents.supervisor import Supervisor
from ms_slam_agents.trainers import Sb3Args as Args
from ms_slam_agents.trainers import sb3 as main
from ms_slam_agents.training_run import (
    alone,
    caught_signals,
    load_run,
    new_curve,
    read_init,
    saved_curve,
    stage_of,
)
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from ms_slam_env._runtime.interrupts import kept
from ms_slam_env._runtime.result_folders import own_folder
from ms_slam_env.errors import InputError


def make_model(args: Args, venv: VecEnv, file: PolicyFile | None) -> Model:
    """Build the model on normalised environments, new or as it stands in ``file``."""
    normalize = VecNormalize(VecMonitor(venv), gamma=args.gamma)
    done = file.metadata.timesteps if file else 0
    options = options_of_dqn if args.algorithm == "dqn" else options_of_ppo
    model = ALGORITHMS[args.algorithm](
        "MlpPolicy",
        normalize,
        learning_rate=args.learning_rate,
        gamma=args.gamma,
        policy_kwargs={"net_arch": [args.hidden, args.hidden], "activation_fn": torch.nn.Tanh},
        tensorboard_log=str(args.out / "tensorboard"),
        seed=args.seed + done,  # a resumed run goes on with new episodes
        device="cpu",
        **options(args, venv, done),
    )
    venv.seed(first_seed(args.seed, done))
    if file:
        restore(model, file)
    elif args.init:
        init = read_init(args)
        assert venv.observation_space.shape
        actions = action_parts(venv.action_space)
        init.metadata.check_sizes(args.init, venv.observation_space.shape[0], *actions)
        restore(model, init.untrained())
    return model


def options_of_ppo(args: Args, venv: VecEnv, done: int) -> dict[str, Any]:
    """Options of PPO after ``done`` steps."""
    n_steps = rollout_steps(args, venv.num_envs, done)
    return {
        "n_steps": n_steps,
        "batch_size": whole_batches(n_steps * venv.num_envs, args.batch_size),
        "n_epochs": args.n_epochs,
        "gae_lambda": args.gae_lambda,
        "ent_coef": args.ent_coef,
        "clip_range": args.clip_range,
    }


def options_of_dqn(args: Args, venv: VecEnv, done: int) -> dict[str, Any]:
    """Options of DQN after ``done`` steps; its replay starts empty.

    Raises:
        InputError: an action of several parts.
    """
    if not isinstance(venv.action_space, Discrete):
        raise InputError(f"{args.env_id} has actions of several numbers: use PPO, not DQN")
    return {
        "buffer_size": args.buffer_size,
        "batch_size": args.batch_size,
        "learning_starts": done + args.learning_starts,
        "train_freq": max(1, args.train_every // venv.num_envs),
        "gradient_steps": max(1, venv.num_envs // args.train_every),
        "target_update_interval": args.target_every * args.train_every,
        "exploration_fraction": args.exploration,
        "exploration_final_eps": args.epsilon,
    }


def rollout_steps(args: Args, num_envs: int, done: int) -> int:
    """Steps of each environment between updates: no more than the budget has left, at least 2."""
    left = math.ceil((args.total_timesteps - done) / num_envs)
    return max(2, min(args.n_steps, left))


@alone
def train(args: Args) -> int:
    """Train as ``args`` say; return the exit status, 130 after Ctrl-C, 143 after SIGTERM.

    Raises:
        InputError: bad options, or nothing to train.
        RuntimeError: time was up before the first update, or a process has ended.
    """
    torch.set_num_threads(1)
    curve = saved_curve(args)
    file = load_run(args, args.algorithm, curve)
    if args.init and file is None:
        read_init(args)  # refused before anything is written
    check_problem(args)  # here, not in a worker process
    say_problem(args)
    own_folder(args.out / "tensorboard")
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
    with (
        opened(make_venv(args, "validation", seeds)) as validation,
        opened(make_venv(args, "train")) as training,
    ):
        model = make_model(args, training, file)
        minutes = file.metadata.minutes if file else 0.0
        curve = curve or new_curve(args, validation)
        if file and curve.steps < file.metadata.timesteps:  # as saved: a reset moves the moments
            judged = file.without_optimizer()
            point = curve.judge(judged, validation, args.out, args.deterministic_eval)
            print(f"{file.metadata.timesteps} steps, made up: {curve.in_words(point)}")
        supervisor = Supervisor(args, validation, curve, minutes)
        if args.curriculum:  # before the first reset
            training.env_method("enter_stage", stage_of(args, model.num_timesteps, curve))
        what = f"what was trained before the last update is kept in {args.out}"
        with caught_signals(supervisor.interrupt), kept(what), supervisor:
            model.learn(
                max(0, args.total_timesteps - model.num_timesteps),
                callback=supervisor,
                tb_log_name=args.algorithm,
                reset_num_timesteps=not args.resume,
            )
    return report(supervisor)


def report(supervisor: Supervisor) -> int:
    """Say how training ended; return the exit status.

    Raises:
        RuntimeError: time was up before the first update.
    """
    args, steps = supervisor.args, supervisor.num_timesteps
    ended = supervisor.stop_reason or "done"
    if not supervisor.has_learnt and not supervisor.signal and not supervisor.was_done:
        why = (
            f"{steps} steps are not more than --learning-starts {args.learning_starts}"
            if args.algorithm == "dqn"
            else f"{supervisor.unlearnt_steps} steps are less than a batch of {args.batch_size}; "
            "give more --minutes or a smaller --batch-size"
        )
        raise RuntimeError(f"{ended}, but nothing was learnt: {why}")
    learnt = "" if supervisor.has_learnt else "; nothing was learnt in this run"
    if supervisor.unlearnt_steps:
        learnt += f"; the last {supervisor.unlearnt_steps} steps, less than a batch, are not in it"
    print(f"{ended}: {steps} steps, policy in {args.out}{learnt}")
    return 128 + supervisor.signal if supervisor.signal else 0


if __name__ == "__main__":
    sys.exit(main())
