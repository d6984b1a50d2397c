"""Base of the training scripts: resume from a file, learn until the steps are made, save after each
update, evaluate regularly, and stop by the clock or a signal."""

from __future__ import annotations

import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from functools import wraps
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import torch
from gymnasium import spaces
from ms_slam_agents.curriculum import read_curriculum, stage_now
from ms_slam_agents.environments import (
    VALIDATION_SEED,
    check_problem,
    env_options,
    make_venv,
    opened,
    say_problem,
)
from ms_slam_agents.evaluation import references
from ms_slam_agents.learning_curve import LATEST, Curve, read_curve
from ms_slam_agents.options import Problem, Training
from ms_slam_agents.policy_file import Metadata, PolicyFile, Tensors, read_policy, write_policy
from ms_slam_agents.resume import (
    JUDGED_WITH,
    KEPT,
    check_kept,
    check_new,
    check_steps_left,
    say_changes,
)
from stable_baselines3.common.vec_env import VecEnv
from torch.utils.tensorboard import SummaryWriter

from ms_slam_env._runtime.interrupts import kept
from ms_slam_env._runtime.progress import Bar
from ms_slam_env._runtime.result_folders import alone_in, own_folder
from ms_slam_env.errors import InputError
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import RESULTS

T = TypeVar("T", bound=Training)
Train = TypeVar("Train", bound=Callable[..., int])

_MEASURES = ("approx_kl", "clip_fraction", "explained_variance", "episode_length")
"""Measures shown in TensorBoard but not in the progress bar."""


class TrainingRun(ABC):
    """A training run and its files.

    Args:
        args: of the training.
        observations: the environments' space.
        actions: the environments' space.
        file: policy file to resume from, if any.

    Raises:
        InputError: an action of several parts.
    """

    algorithm: ClassVar[str]
    venv: VecEnv

    def __init__(
        self, args: Training, observations: spaces.Space, actions: spaces.Space, file: Any
    ) -> None:
        if not isinstance(actions, spaces.Discrete):
            raise InputError(f"{args.env_id} has actions of several numbers: use ms-slam train sb3")
        assert observations.shape
        self.options = args
        self.inputs, self.actions = observations.shape[0], int(actions.n)
        self.steps = file.metadata.timesteps if file else 0
        self.epochs = file.metadata.epochs if file else 0
        self.minutes = file.metadata.minutes if file else 0.0
        self._provenance = provenance()

    @abstractmethod
    def advance(self, stop: Callable[[], bool]) -> dict[str, float] | None:
        """Play and learn for a while, counting ``steps`` and ``epochs``.

        Returns:
            Measures to report; None if ``stop()`` ended it early.
        """

    def enter_stage(self, stage: int) -> None:
        """Switch the environments to a stage of the curriculum at their next episodes."""
        self.venv.env_method("enter_stage", stage)

    @abstractmethod
    def tensors(self) -> Tensors:
        """The current policy, with the state of the optimiser."""

    def metadata(self) -> Metadata:
        """Metadata of the current policy."""
        return metadata_of(
            self.options,
            self.algorithm,
            inputs=self.inputs,
            actions=(self.actions,),
            candidates=self.options.candidates,
            image=self.options.image,
            timesteps=self.steps,
            epochs=self.epochs,
            minutes=self.minutes,
            provenance=self._provenance,
        )

    def file(self) -> PolicyFile:
        """The current policy, with the state of the optimiser."""
        return PolicyFile(self.metadata(), self.tensors())

    def learn(self, curve: Curve, validation: VecEnv) -> signal.Signals | None:
        """Advance until the steps are made, or time is up.

        Returns:
            The signal that ended it early, if any. A signal during an evaluation, which may take
            minutes, raises KeyboardInterrupt.
        """
        args, before = self.options, self.minutes
        board = SummaryWriter(str(own_folder(args.out / "tensorboard")))
        bar = Bar(
            total=args.total_timesteps,
            desc="training",
            initial=self.steps,
            unit="step",
            smoothing=0.1,
        )
        signals: list[signal.Signals] = []
        with board, bar:
            if not curve.points:
                write_policy(args.out / LATEST, self.file())
            if curve.is_due(self.steps, args.eval_every):
                self._judge(curve, validation, board)
            while self.steps < args.total_timesteps:
                if args.minutes is not None and self.minutes - before >= args.minutes:
                    break
                steps, begun = self.steps, time.monotonic()
                if args.curriculum:
                    self.enter_stage(stage_of(args, self.steps, curve))
                with caught_signals(signals.append):
                    said = self.advance(lambda: bool(signals))
                if said is None:
                    break
                seconds = time.monotonic() - begun
                self.minutes += seconds / 60
                bar.update(self.steps - steps)
                bar.set_postfix({k: f"{v:.3g}" for k, v in said.items() if k not in _MEASURES})
                said["steps_per_s"] = (self.steps - steps) / max(seconds, 1e-9)
                for name, value in said.items():
                    board.add_scalar(f"train/{name}", value, self.steps)
                write_policy(args.out / LATEST, self.file())
                if signals:
                    break
                if curve.is_due(self.steps, args.eval_every):
                    self._judge(curve, validation, board)
            if not signals and curve.steps < self.steps:
                self._judge(curve, validation, board)
        return signals[0] if signals else None

    def _judge(self, curve: Curve, validation: VecEnv, board: SummaryWriter) -> None:
        """Evaluate, and keep the best policy so far."""
        file = self.file().without_optimizer()
        point = curve.judge(file, validation, self.options.out, self.options.deterministic_eval)
        for name in point.keys() - {"returns", "timesteps", "training_min"}:
            board.add_scalar(f"validation/{name}", point[name], self.steps)
        Bar.write(f"{self.steps} steps, {self.minutes:.1f} min: {curve.in_words(point)}")


def alone(train: Train) -> Train:
    """Let one process at a time train in the folder ``out`` of the options, the first argument."""

    @wraps(train)
    def alone(args: Any, *more: Any) -> int:
        with alone_in(args.out):
            return train(args, *more)

    return cast(Train, alone)


@alone
def train_run(
    args: T, algorithm: str, make: Callable[[T, PolicyFile | None, ExitStack], TrainingRun]
) -> int:
    """Train as ``args`` say; return the exit status, 130 after Ctrl-C, 143 after SIGTERM.

    Args:
        args: of the training.
        algorithm: value of ``algorithm`` in the run's policy file.
        make: makes the run, new or from a file, and lets the stack close what it opens.

    Raises:
        InputError: bad options, or nothing to train.
        RuntimeError: the process of an environment has ended.
    """
    torch.set_num_threads(1)
    curve = saved_curve(args)
    file = load_run(args, algorithm, curve)
    if args.init and file is None:
        read_init(args)  # refused before anything is written
    check_problem(args)
    say_problem(args)
    with ExitStack() as stack:
        seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
        validation = stack.enter_context(opened(make_venv(args, "validation", seeds)))
        run = make(args, file, stack)
        args.out.mkdir(parents=True, exist_ok=True)
        with kept(f"what was trained before the last update is kept in {args.out}"):
            ended_by = run.learn(curve or new_curve(args, validation), validation)
    ended = f"interrupted by {ended_by.name}" if ended_by else "done"
    print(f"{ended}: {run.steps} steps, policy in {args.out}")
    return 128 + ended_by if ended_by else 0


@contextmanager
def caught_signals(tell: Callable[[signal.Signals], Any]) -> Iterator[None]:
    """Record SIGINT and SIGTERM instead of stopping; a second one stops at once."""
    before: dict[int, Any] = {}

    def handle(number: int, _: object) -> None:
        signal.signal(number, before[number])
        tell(signal.Signals(number))

    for name in (signal.SIGINT, signal.SIGTERM):
        before[name] = signal.signal(name, handle)
    try:
        yield
    finally:
        for caught, handler in before.items():
            signal.signal(caught, handler)


def stage_of(args: Training, steps: int, curve: Curve) -> int:
    """The current stage of the curriculum."""
    assert args.curriculum
    return stage_now(read_curriculum(args.curriculum), steps, curve.points, args.total_timesteps)


def metadata_of(args: Any, algorithm: str, **counts: Any) -> Metadata:
    """What a policy file says, of the options that all trainers have and of ``counts``."""
    return Metadata(
        algorithm=algorithm,
        env_id=args.env_id,
        env_options=env_options(args),
        observation=args.observation,
        hidden=(args.hidden, args.hidden),
        options=to_plain(asdict(args)),
        **counts,
    )


def load_run(args: Training, algorithm: str, curve: Curve | None) -> PolicyFile | None:
    """Load the run to resume from; None for a new run.

    Raises:
        InputError: nothing to resume from, nothing left to train or to judge, another network or
            problem, or a new run where there is one already.
    """
    if not args.resume:
        check_new(args.out, LATEST)
        return None
    file = read_run(args, algorithm, {*KEPT, *args.kept})
    path, done = args.out / LATEST, file.metadata.timesteps
    if curve is None or curve.steps >= done:
        check_steps_left(path, done, args.total_timesteps)
    if file.metadata.epochs and not file.can_resume:
        raise InputError(f"{path} has no state of the optimiser to resume from")
    say_changes(file.metadata.options, args)
    return file


def read_run(args: Problem, algorithm: str, names: set[str]) -> PolicyFile:
    """The policy file of the run in ``args.out``.

    Raises:
        InputError: there is none, or one of another algorithm or other options ``names``.
    """
    path = args.out / LATEST
    file = read_policy(path)
    if file.metadata.algorithm != algorithm:
        raise InputError(f"{path} is of {file.metadata.algorithm}, not of {algorithm}")
    check_kept(path, file.metadata.options, args, sorted(names))
    return file


def saved_curve(args: Problem) -> Curve | None:
    """The learning curve of the run to resume; None where there is none yet.

    Raises:
        InputError: its points are of other episodes than those to come would be.
    """
    path = args.out / RESULTS
    if not (args.resume and path.is_file()):
        return None
    curve = read_curve(path)
    check_kept(path, curve.config, args, JUDGED_WITH, "has points judged with")
    return replace(curve, config=to_plain(asdict(args)))


def new_curve(args: Training, validation: VecEnv) -> Curve:
    """A learning curve without points, with the requested references."""
    known = references(validation, args.eval_episodes) if args.references else {}
    return Curve(args.eval_episodes, known, config=to_plain(asdict(args)))


def read_init(args: Training) -> PolicyFile:
    """The policy to begin with.

    Raises:
        InputError: no policy, or one of another network or observation.
    """
    assert args.init
    return read_similar(args.init, args, args.hidden)


def read_similar(path: Path, args: Problem, hidden: int) -> PolicyFile:
    """Read a policy of any task with the observation and layers of ``args``, ``hidden`` wide.

    Raises:
        InputError: no policy, or another one.
    """
    file = read_policy(path)
    known = file.metadata
    if known.observation != args.observation:
        raise InputError(
            f"{path} is for observation {known.observation!r}, not {args.observation!r}"
        )
    if tuple(known.hidden) != (hidden, hidden):
        raise InputError(f"{path} has layers of {known.hidden}: give --hidden that")
    for name, own in args.layers.items():
        if getattr(known, name) != own:
            raise InputError(
                f"{path} has a network with {name} = {getattr(known, name)}; this one has {own}"
            )
    return file
