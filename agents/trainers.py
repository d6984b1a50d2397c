"""``ms-slam train NAME``: the options of each trainer, and the call of the trainer.

Torch, Stable-Baselines3 and Ray take seconds to load, so options are checked before that.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from ms_slam_agents.options import PpoTraining, Problem, ReplayTraining
from ms_slam_agents.resume import parse_options

from ms_slam_env._runtime.command_line import exit_code, parse
from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env.config import bounded
from ms_slam_env.errors import InputError

Sb3Algorithm = Literal["maskable_ppo", "ppo", "dqn"]


@dataclass(frozen=True)
class Sb3Args(PpoTraining, ReplayTraining):
    """Train a camera-motion policy with PPO or DQN; these options are the command line.

    Those from ``buffer_size`` to ``save_every`` are DQN's; ``n_steps``, ``n_epochs``,
    ``gae_lambda``, ``ent_coef`` and ``clip_range`` are PPO's.

    Attributes:
        algorithm: PPO over the actions that are not blocked, or PPO or DQN over all of them.
    """

    out: Path = Path("runs/sb3")
    algorithm: Sb3Algorithm = "maskable_ppo"
    eval_every: int = bounded(10_000, 0, 1_000_000_000)
    references: bool = True
    batch_size: int = bounded(128, 2, 1_000_000)
    n_epochs: int = bounded(8, 1, 1000)
    learning_rate: float = bounded(3e-4, 0, 1)
    hidden: int = bounded(128, 1, 4096)

    algorithms = get_args(Sb3Algorithm)

    @property
    def layers(self) -> dict[str, Any]:
        """See `Problem`; Stable-Baselines3 sees one long vector."""
        quantiles = int(self.algorithm == "dqn")  # the value of an action is its one quantile
        return {**super().layers, "candidates": 0, "image": (), "quantiles": quantiles}


@dataclass(frozen=True)
class ImitationArgs(Problem):
    """Learn from a planner; these options are the command line.

    Attributes:
        teacher: a planner, NAME,option=value,...
        init: policy file to start from, its network and normalisation; it may be of another task.
        through: planner through which the policy acts after the first round, as its option
            ``path``; `agent-home` goes to distant goals itself. Only decisions that the teacher
            rates are then learned from. None: the policy acts by itself.
        rounds: number of rounds of episodes and fitting; in the first the teacher acts.
        episodes: number of episodes per round.
        share: share of the decisions that the teacher makes in the second round; it halves in each
            further round.
        epochs: passes over all episodes so far, in each round.
        batch_size: steps per gradient step.
        learning_rate: of Adam.
        value_weight: weight of the value error in the loss.
        gamma: discount factor of the returns.
        hidden: width of the two hidden layers.
        dropout: share of the layers' input set to zero, drawn for each gradient step.
        memory: width of the recurrent unit; 0: the policy sees only the present observation. With a
            memory, a batch is whole episodes with about ``batch_size`` steps together, at least
            one.
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

    algorithms = ("imitation",)

    @property
    def layers(self) -> dict[str, Any]:
        """See the base class; a policy to begin with has the same memory."""
        return {**super().layers, "memory": self.memory}


@dataclass(frozen=True)
class PpoArgs(PpoTraining):
    """Train with masked PPO, with memory or without; these options are the command line.

    Attributes:
        pull: initial weight of the divergence from the initial policy; it falls linearly to 0.
        pull_steps: environment steps until the weight is 0.
        memory: width of the recurrent unit; 0: the policy sees only the present observation.
        chunk: steps over which gradients go back through the memory; ``n_steps`` is a multiple.
        value_weight: of the error of the value in the loss.
    """

    out: Path = Path("runs/ppo")
    pull: float = bounded(0.0, 0, 1000)
    pull_steps: int = bounded(100_000, 1, 1_000_000_000)
    memory: int = bounded(0, 0, 4096)
    chunk: int = bounded(16, 1, 10_000)
    value_weight: float = bounded(0.5, 0, 1000)

    algorithms = ("masked_ppo",)
    kept: ClassVar[tuple[str, ...]] = ("memory",)

    def __post_init__(self) -> None:
        """Refuse values out of range, chunks that leave steps over, a pull to nothing."""
        super().__post_init__()
        if self.memory and self.n_steps % min(self.chunk, self.n_steps):
            raise InputError(f"n_steps = {self.n_steps} is not a multiple of chunk = {self.chunk}")
        if self.pull and self.init is None:
            raise InputError("--pull needs --init (the policy to stay close to)")

    @property
    def layers(self) -> dict[str, Any]:
        """See the base class; a policy to begin with has the same memory."""
        return {**super().layers, "memory": self.memory}


@dataclass(frozen=True)
class QrdqnArgs(ReplayTraining):
    """Train with masked QR-DQN; these options are the command line.

    Attributes:
        quantiles: number of quantiles of the return per action.
        n_step: number of rewards in a return before the target network's estimate is used.
        batch_size: of the gradient steps, in transitions.
    """

    out: Path = Path("runs/qrdqn")
    quantiles: int = bounded(32, 1, 1000)
    n_step: int = bounded(3, 1, 1000)
    batch_size: int = bounded(128, 1, 1_000_000)

    algorithms = ("qr_dqn",)
    kept: ClassVar[tuple[str, ...]] = ("quantiles",)

    @property
    def layers(self) -> dict[str, int]:
        """See `Problem`."""
        return {**super().layers, "quantiles": self.quantiles}


@dataclass(frozen=True)
class RllibArgs(PpoTraining):
    """Train with masked PPO on Ray; these options are the command line.

    Attributes:
        num_envs: environment runners, one process and one thread each, on all machines together.
        envs_per_runner: environments that a runner steps one after the other.
        address: of a Ray cluster, or ``auto``; None: one on this machine, for this run.
        value_weight: of the error of the value in the loss.
    """

    out: Path = Path("runs/rllib")
    envs_per_runner: int = bounded(1, 1, 10_000)
    address: str | None = None
    value_weight: float = bounded(0.5, 0, 1000)

    algorithms = ("rllib_ppo",)

    def __post_init__(self) -> None:
        """Refuse values out of range, and a batch that is larger than a round."""
        super().__post_init__()
        if self.batched != "no":
            raise InputError("batched: the runners of Ray step their environments one by one")
        if self.batch_size > self.round_steps:
            raise InputError(
                f"batch_size = {self.batch_size} is larger than a round of {self.round_steps} "
                "steps (n_steps x num_envs x envs_per_runner)"
            )

    @property
    def round_steps(self) -> int:
        """Steps of all environments between updates."""
        return self.n_steps * max(1, self.fewest_runners) * self.envs_per_runner

    @property
    def fewest_runners(self) -> int:
        """Environment runners that a round has at least."""
        return self.num_envs


@dataclass(frozen=True)
class RllibScaling(RllibArgs):
    """Measure steps per second with several numbers of runners; these options are the command line.

    Attributes:
        runners: numbers of environment runners to measure, one after the other.
        rounds: measured rounds of ``n_steps`` steps per runner and an update, after one round of
            warm-up, in which scenes are built and kernels loaded.
    """

    out: Path = Path("runs/rllib-scaling")
    runners: tuple[int, ...] = (1, 2, 4)
    rounds: int = bounded(2, 1, 10_000)
    n_steps: int = bounded(128, 2, 1_000_000)
    batch_size: int = bounded(128, 2, 1_000_000)

    @property
    def fewest_runners(self) -> int:
        """See `RllibArgs`."""
        return min(self.runners, default=1)


# -- Command lines -----------------------------------------------------------------------------

_TRAINING = ExtensionPoint(
    "trainer",
    "ms_slam_env.trainers",
    own={
        "sb3": "ms_slam_agents.train_sb3:train",
        "imitation": "ms_slam_agents.imitation:train",
        "ppo": "ms_slam_agents.ppo:train",
        "qrdqn": "ms_slam_agents.qrdqn:train",
        "rllib": "ms_slam_agents.train_rllib:train",
        "rllib scaling": "ms_slam_agents.rllib_scaling:scale",
    },
)
"""What trains as its options, of the types above, say; returns the exit code."""


def sb3(argv: Sequence[str] | None = None) -> int:
    """Masked PPO, PPO or DQN of Stable-Baselines3, without memory; the default.

    Returns:
        the exit code: 0, 1 if nothing was learnt, 2, 130 or 143.
    """
    return _run("sb3", Sb3Args, argv, "ms-slam train")


def imitation(argv: Sequence[str] | None = None) -> int:
    """Imitation of a planner (DAgger), with memory or without.

    Returns:
        the exit code: 0, 1 if an episode failed, 2, 130 or 143.
    """
    return _run("imitation", ImitationArgs, argv)


def ppo(argv: Sequence[str] | None = None) -> int:
    """Masked PPO of the package, with memory or without; can stay close to a policy.

    Returns:
        the exit code: 0, 1, 2, 130 or 143.
    """
    return _run("ppo", PpoArgs, argv)


def qrdqn(argv: Sequence[str] | None = None) -> int:
    """Masked QR-DQN, off-policy, with n-step returns.

    Returns:
        the exit code: 0, 1, 2, 130 or 143.
    """
    return _run("qrdqn", QrdqnArgs, argv)


def rllib(argv: Sequence[str] | None = None) -> int:
    """Masked PPO of RLlib on a Ray cluster; "rllib scaling" measures its speed.

    Returns:
        the exit code: 0, 1, 2, 130 or 143.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] != ["scaling"]:
        return _run("rllib", RllibArgs, words)
    prog = "ms-slam train rllib scaling"

    def run() -> int:
        args = parse(RllibScaling, words[1:], prog)
        return int(_TRAINING.find("rllib scaling")(args))

    return exit_code(run, prog)


def _run(name: str, cls: type[Problem], argv: Sequence[str] | None, prog: str = "") -> int:
    """Read the options ``cls`` of a command line, then train."""
    words = list(sys.argv[1:] if argv is None else argv)
    prog = prog or f"ms-slam train {name}"

    def run() -> int:
        args = parse_options(cls, words, prog, name, cls.algorithms)
        return int(_TRAINING.find(name)(args))

    return exit_code(run, prog)
