"""Learn from a planner: behaviour cloning, then DAgger (Ross et al., AISTATS 2011).

    ms-slam train imitation --teacher nbv --observation map --out runs/imitation

In the first round the teacher acts. In later ones the policy does, more and more, and the teacher
says what it would have done where the policy has come to; the network is fitted to all rounds so
far: to the teacher's actions, and its value to the returns met. Writes into ``out`` what
``ms-slam train`` writes, and ``episodes/``; ``ms-slam train --init`` goes on from it with PPO.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ms_slam_agents.demonstrations import Demonstration, Task, play
from ms_slam_agents.environments import (
    VALIDATION_SEED,
    check_problem,
    make_venv,
    problem_options,
)
from ms_slam_agents.learning_curve import LATEST, Curve, read_curve
from ms_slam_agents.network import Network, load_parameters
from ms_slam_agents.normalization import PooledMoments
from ms_slam_agents.options import Problem, check_new, parse_for_task
from ms_slam_agents.policy import CLIP, EPSILON
from ms_slam_agents.policy_file import PolicyFile, write_policy
from ms_slam_agents.training_run import metadata_of, read_run, read_similar
from tqdm import tqdm

from ms_slam_env.command_line import exit_code
from ms_slam_env.config import bounded
from ms_slam_env.env.planners import check_planner
from ms_slam_env.errors import InputError
from ms_slam_env.parallel import one_thread_unless_set, open_pool, run_each
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import RESULTS

_TRAINING_SEED = 500_000  # of the first episode; far from validation's


@dataclass(frozen=True)
class Args(Problem):
    """Learn from a planner; these options are the command line.

    Attributes:
        teacher: a planner, NAME,option=value,...
        init: policy file to begin with, its network and normalisation; it may be of another task.
        through: planner that the policy acts through in the rounds after the first, as its option
            ``path``: `agent-home` has goals for the way to what is not near by. Then only the
            decisions count that the teacher weighs. None: the policy acts by itself.
        rounds: of episodes and fitting; in the first the teacher acts.
        episodes: of each round.
        share: of the decisions that are the teacher's in the second round; half as many in each
            round after it.
        epochs: passes over all episodes so far, each round.
        batch_size: of the gradient steps.
        learning_rate: of Adam.
        value_weight: of the error of the value in the loss.
        gamma: discount factor of the returns.
        hidden: width of the two hidden layers.
        dropout: share of what the layers see that is zero, drawn anew for each gradient step.
        memory: width of the recurrent unit; 0: the policy sees the present observation alone. With
            one, a batch is of whole episodes, as many as have ``batch_size`` steps together, one
            at least.
    """

    out: Path = Path("runs/imitation")
    teacher: str = "nbv"
    init: Path | None = None
    through: str | None = None
    rounds: int = bounded(5, 1, 1000)
    episodes: int = bounded(40, 1, 100_000)
    share: float = bounded(0.5, 0, 1)
    epochs: int = bounded(10, 1, 1000)
    batch_size: int = bounded(256, 2, 1_000_000)
    learning_rate: float = bounded(5e-4, 0, 1)
    value_weight: float = bounded(0.1, 0, 1000)
    gamma: float = bounded(0.98, 0, 1)
    hidden: int = bounded(256, 1, 4096)
    dropout: float = bounded(0.0, 0, 0.99)
    memory: int = bounded(0, 0, 4096)

    @property
    def layers(self) -> dict[str, Any]:
        """See the base class; a policy to begin with has the same memory."""
        return {**super().layers, "memory": self.memory}


# -- Episodes ----------------------------------------------------------------------------------


def tasks(args: Args, number: int) -> list[Task]:
    """The episodes of a round, each with a seed of its own."""
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
    """Play those episodes of a round that are not there yet.

    Raises:
        InputError: options that the environment or the teacher refuses.
        RuntimeError: an episode that failed.
    """
    missing = {task.path: task for task in tasks(args, number) if not task.path.exists()}
    if not missing:
        return
    (args.out / "episodes").mkdir(parents=True, exist_ok=True)
    environment = one_thread_unless_set()
    with open_pool(play, args.num_envs, environment=environment) as pool:
        for outcome in tqdm(
            run_each(pool, missing), f"round {number}", len(missing), unit="episode"
        ):
            if outcome.error:
                kind = InputError if outcome.is_bad_input else RuntimeError
                raise kind(f"episode {outcome.key.name}: {outcome.message or outcome.error}")


# -- Fitting -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Moments:
    """Means and variances by which observations and returns are normalised, as SB3 does it."""

    mean: Any
    var: Any
    count: float

    @classmethod
    def of(cls, values: Any) -> Moments:
        """Of the rows of an array."""
        wide = values.astype(np.float64)
        return cls(wide.mean(axis=0), wide.var(axis=0), float(len(values)))

    @classmethod
    def read(cls, file: PolicyFile, name: str) -> Moments:
        """As ``tensors`` wrote them."""
        part = file.part(name)
        return cls(part["mean"], part["var"], float(part["count"]))

    def tensors(self, name: str) -> dict[str, Any]:
        """For a policy file."""
        count = np.array(self.count)
        parts = {"mean": self.mean, "var": self.var, "count": count}
        return {f"{name}.{part}": np.asarray(v, np.float64) for part, v in parts.items()}

    @property
    def std(self) -> Any:
        """Standard deviations, never zero."""
        return np.sqrt(self.var + EPSILON)


class Student:
    """The network that learns, with its normalisation.

    Args:
        args: of the training.
        demonstrations: of the first round, which the normalisation is taken from.
        file: to go on from.
        epochs: done before.

    Raises:
        InputError: a file for other observations or actions.
    """

    def __init__(
        self,
        args: Args,
        demonstrations: Sequence[Demonstration],
        file: PolicyFile | None,
        epochs: int = 0,
    ) -> None:
        self.args = args
        first = demonstrations[0]
        self.inputs, self.actions = first.observations.shape[1], first.masks.shape[1]
        if file:
            self.seen, self.returns = (Moments.read(file, n) for n in ("observation", "return"))
        else:
            self.seen = self._moments(np.concatenate([d.observations for d in demonstrations]))
            sums = np.concatenate([d.returns(args.gamma) for d in demonstrations])
            self.returns = Moments.of(sums)
        torch.manual_seed(args.seed)
        width, actions = args.hidden, self.actions
        self.network = Network(
            self.inputs,
            width,
            actions,
            args.memory,
            args.candidates,
            dropout=args.dropout,
            image=args.image,
        )
        self.epochs = epochs
        if file:
            file.metadata.check_sizes(args.init or args.out, self.inputs, self.actions)
            load_parameters(self.network, file)

    def _moments(self, observations: Any) -> Moments:
        """Means and variances of observations (N, inputs), the same for all candidates."""
        candidates = self.args.candidates
        if not candidates:
            return Moments.of(observations)
        pooled = PooledMoments(self.inputs, self.actions, candidates)
        mean, var = pooled.pooled(observations.astype(np.float64))
        return Moments(mean, var, float(len(observations)))

    def fit(self, demonstrations: Sequence[Demonstration]) -> dict[str, float]:
        """Learn from all episodes; return the loss and the share of the teacher's choice at last.

        The loss is the cross entropy to what the teacher prefers.
        """
        args = self.args
        data = _Batches(demonstrations, args, np.random.default_rng([args.seed, self.epochs]))
        optimizer = torch.optim.Adam(self.network.parameters(), lr=args.learning_rate)
        said: list[tuple[float, float]] = []
        for k, (observations, masks, is_step, preferences, returns) in enumerate(data):
            optimizer.param_groups[0]["lr"] = args.learning_rate * (1 - k / len(data))
            scaled = np.clip((observations - self.seen.mean) / self.seen.std, -CLIP, CLIP)
            seen = torch.as_tensor(scaled, dtype=torch.float32)
            can = torch.as_tensor(masks)
            empty, begins = torch.zeros(seen.shape[1], args.memory), torch.zeros(seen.shape[:2])
            log_probs, values = self.network.along(seen, empty, begins, can)
            log_probs = log_probs.masked_fill(~can.flatten(0, 1), 0)  # of what cannot be: nothing
            log_probs, values = log_probs[is_step], values[is_step]
            wanted = torch.as_tensor(preferences, dtype=torch.float32)
            target = torch.as_tensor(returns / self.returns.std, dtype=torch.float32)
            error = torch.mean((values - target) ** 2)
            loss = -(wanted * log_probs).sum(dim=1).mean() + args.value_weight * error
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            optimizer.step()
            chosen = log_probs.gather(1, wanted.argmax(dim=1, keepdim=True))
            weighed = wanted.sum(dim=1) > 0
            said.append((loss.item(), chosen[weighed].exp().mean().item()))
        self.epochs += args.epochs
        losses, probabilities = np.transpose(said[-max(1, len(said) // args.epochs) :])
        return {"loss": float(losses.mean()), "probability": float(np.nanmean(probabilities))}

    def file(self, timesteps: int, minutes: float) -> PolicyFile:
        """The policy as it is now."""
        args = self.args
        metadata = metadata_of(
            args,
            "imitation",
            inputs=self.inputs,
            actions=(self.actions,),
            memory=args.memory,
            candidates=args.candidates,
            image=args.image,
            timesteps=timesteps,
            epochs=self.epochs,
            minutes=minutes,
            provenance=provenance(),
        )
        network = {f"policy.{n}": p.numpy() for n, p in self.network.state_dict().items()}
        moments = self.seen.tensors("observation") | self.returns.tensors("return")
        return PolicyFile(metadata, network | moments)


class _Batches:
    """All episodes in batches, shuffled anew in each epoch: steps, or whole episodes if a memory
    learns from them.

    A batch is observations (L, B, k) and masks (L, B, n), where episodes that are shorter than the
    longest are filled up, which of these L B are steps, and their preferences and returns.
    """

    def __init__(
        self, demonstrations: Sequence[Demonstration], args: Args, rng: np.random.Generator
    ) -> None:
        self.args, self.rng = args, rng
        parts = [
            (d.observations, d.masks, d.preferences, d.returns(args.gamma)) for d in demonstrations
        ]
        self._columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        steps = np.array([len(d.rewards) for d in demonstrations])
        self._lengths = steps if args.memory else np.ones(steps.sum(), int)
        self._starts = np.cumsum(self._lengths) - self._lengths
        at_once = max(1, args.batch_size // int(self._lengths.max()))
        self._batches = math.ceil(len(self._lengths) / at_once)

    def __len__(self) -> int:
        return self.args.epochs * self._batches

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        observations, masks, preferences, returns = self._columns
        for _ in range(self.args.epochs):
            order = self.rng.permutation(len(self._lengths))
            for chosen in np.array_split(order, self._batches):
                lengths = self._lengths[chosen]
                step = np.arange(lengths.max())[:, None]
                at = self._starts[chosen] + np.minimum(step, lengths - 1)
                is_step = (step < lengths).ravel()
                steps = at.ravel()[is_step]
                seen = observations[at].astype(np.float32)
                yield seen, masks[at], is_step, preferences[steps], returns[steps]


# -- Training ----------------------------------------------------------------------------------


def load_run(args: Args) -> tuple[PolicyFile | None, int]:
    """What there is to resume, and the rounds done; None and 0 for a new run.

    Raises:
        InputError: a new run where there is one already, nothing to resume from, or another one.
    """
    path = args.out / LATEST
    if not args.resume:
        check_new(args.out, LATEST, "episodes")
        return None, 0
    if not path.exists():
        return None, 0  # interrupted in the first round
    names = {"env_id", "observation", "hidden", "teacher", "episodes", "epochs", "seed", "reward"}
    file = read_run(args, "imitation", names | {"through", "without", "memory"})
    return file, file.metadata.epochs // args.epochs


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
    file, done = load_run(args)
    begun = None
    if args.init and not done:
        begun = read_similar(args.init, args, args.hidden, ["observation"])
    check_problem(args)
    curve = Curve(args.eval_episodes, {}, config=to_plain(asdict(args)))
    if done and (args.out / RESULTS).is_file():
        curve = replace(read_curve(args.out / RESULTS), config=curve.config)
    if done >= args.rounds:
        raise InputError(f"{args.out} has {done} rounds already: give more than --rounds {done}")
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
    started = time.monotonic() - 60 * curve.minutes
    for number in range(done, args.rounds):
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
        file = student.file(steps, (time.monotonic() - started) / 60)
        venv = make_venv(args, "validation", seeds)
        try:
            point = curve.judge(file, venv, args.out, args.deterministic_eval)
        finally:
            venv.close()
        write_policy(args.out / LATEST, file)  # last: a round without it is done again
        print(
            f"round {number}: {steps} steps, loss {said['loss']:.3f}, the teacher's action has "
            f"probability {said['probability']:.2f}; {curve.in_words(point)}",
            flush=True,
        )
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, 1 if an episode failed, 2, 130."""
    words = list(sys.argv[1:] if argv is None else argv)
    return exit_code(
        lambda: train(parse_for_task(Args, words, "ms-slam train imitation", "imitation")),
        "ms-slam train imitation",
    )


if __name__ == "__main__":
    sys.exit(main())
