"""Learn from a planner: behaviour cloning, then DAgger (Ross et al., AISTATS 2011).

    ms-slam train imitation --teacher nbv --observation map --out runs/imitation

In the first round the teacher acts. In later rounds the policy acts increasingly, and the teacher
labels the visited states with its own actions. The network is fitted to all rounds so far: its
policy to the teacher's actions, its value to the observed returns. Writes the files of ``ms-slam
train`` and ``episodes/`` into ``out``; continue from it with PPO by ``ms-slam train --init``.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict

import numpy as np
import torch
from ms_slam_agents.demonstrations import Demonstration, Task, play
from ms_slam_agents.environments import (
    VALIDATION_SEED,
    check_problem,
    make_venv,
    opened,
    problem_options,
    say_problem,
)
from ms_slam_agents.learning_curve import LATEST, Curve, read_curve
from ms_slam_agents.policy_file import PolicyFile, write_policy
from ms_slam_agents.resume import KEPT, check_kept, check_new, say_changes
from ms_slam_agents.student import Student
from ms_slam_agents.trainers import ImitationArgs as Args
from ms_slam_agents.trainers import imitation as main
from ms_slam_agents.training_run import alone, read_run, read_similar, saved_curve

from ms_slam_env._runtime.parallel import open_pool, run_each
from ms_slam_env._runtime.progress import Bar
from ms_slam_env._runtime.result_folders import own_folder
from ms_slam_env._runtime.threads import one_thread_unless_set
from ms_slam_env.config import parse_named
from ms_slam_env.env.planners import PLANNERS, check_planner
from ms_slam_env.errors import InputError
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import RESULTS

_TRAINING_SEED = 500_000  # of the first episode
_OWN_PROBLEM = {*KEPT, "teacher", "episodes", "epochs", "seed", "memory"}
"""Options that all rounds of a run have in common."""


# -- Episodes ----------------------------------------------------------------------------------


def tasks(args: Args, number: int) -> list[Task]:
    """The episodes of a round, each with a different seed."""
    options = problem_options(args, "train")
    first = _TRAINING_SEED + args.seed * 100_000 + number * args.episodes
    return [
        Task(
            path=args.out / "episodes" / f"{number:03}_{k:05}.npz",
            env_id=args.env_id,
            options=tuple(options.items()),
            seed=first + k,
            teacher=args.teacher,
            policy=args.out / LATEST if number else None,
            share=args.share / 2 ** (number - 1) if number else 1.0,
            through=args.through,
        )
        for k in range(args.episodes)
    ]


def play_round(args: Args, number: int) -> None:
    """Play the missing episodes of a round.

    Raises:
        InputError: options that the environment or the teacher refuses.
        RuntimeError: an episode failed.
    """
    missing = {task.path: task for task in tasks(args, number) if not task.path.exists()}
    if not missing:
        return
    own_folder(args.out / "episodes")
    environment = one_thread_unless_set()
    with open_pool(play, args.num_envs, environment=environment) as pool:
        for outcome in Bar(
            run_each(pool, missing), f"round {number}", len(missing), unit="episode"
        ):
            if outcome.error:
                kind = InputError if outcome.is_bad_input else RuntimeError
                raise kind(f"episode {outcome.key.name}: {outcome.message or outcome.error}")


# -- Training ----------------------------------------------------------------------------------


def load_run(args: Args) -> tuple[PolicyFile | None, int]:
    """Load the run to resume from, and its number of rounds; None and 0 for a new run.

    Raises:
        InputError: a new run in a folder that has one, nothing to resume from, or another run.
    """
    if not args.resume:
        check_new(args.out, LATEST, "episodes")
        return None, 0
    if not (args.out / LATEST).exists():  # interrupted in the first round
        if (args.out / RESULTS).is_file():
            begun = read_curve(args.out / RESULTS)
            check_kept(args.out / RESULTS, begun.config, args, sorted(_OWN_PROBLEM))
        return None, 0
    file = read_run(args, "imitation", _OWN_PROBLEM)
    say_changes(file.metadata.options, args)
    return file, file.metadata.epochs // args.epochs


@alone
def train(args: Args) -> int:
    """Train as ``args`` say; return the exit status.

    Raises:
        InputError: bad options, or nothing to train.
        RuntimeError: an episode that failed.
    """
    torch.set_num_threads(1)
    check_planner(args.teacher)
    if args.through:
        check_planner(args.through, path="")
        layer = PLANNERS.find(parse_named(args.through, "planner")[0])
        if hasattr(layer, "check_policy"):
            layer.check_policy(args.observation)
    file, done = load_run(args)
    curve = saved_curve(args) or Curve(args.eval_episodes, {}, config=to_plain(asdict(args)))
    begun = None
    if args.init and not done:
        begun = read_similar(args.init, args, args.hidden)
    check_problem(args)
    say_problem(args)
    if done >= args.rounds:
        raise InputError(f"{args.out} has {done} rounds already: give more than --rounds {done}")
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
    minutes = file.metadata.minutes if file else 0.0
    curve.write(args.out)  # before the first episode: what the run is of
    for number in range(done, args.rounds):
        started = time.monotonic()
        play_round(args, number)
        paths = [task.path for n in range(number + 1) for task in tasks(args, n)]
        demonstrations = [Demonstration.read(path) for path in paths]
        if not any(np.any(d.preferences) for d in demonstrations):
            raise InputError(
                f"teacher {args.teacher} weighs no decision of a policy that acts through "
                f"{args.through}; oracle, held-nbv and foresight do"
            )
        student = Student(
            args, demonstrations[: args.episodes], file or begun, number * args.epochs
        )
        said = student.fit(demonstrations)
        steps = sum(len(d.rewards) for d in demonstrations)
        minutes += (time.monotonic() - started) / 60
        file = student.file(steps, minutes)
        with opened(make_venv(args, "validation", seeds)) as venv:
            point = curve.judge(file, venv, args.out, args.deterministic_eval)
        write_policy(args.out / LATEST, file)  # last: a round without it is done again
        print(
            f"round {number}: {steps} steps, loss {said['loss']:.3f}, the teacher's action has "
            f"probability {said['probability']:.2f}; {curve.in_words(point)}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
