"""QR-DQN with action masks: quantiles of the return, learned from replay.

    ms-slam train qrdqn --task room --out runs/qrdqn

From top to bottom: replay, play, loss, run. Quantile regression is Dabney et al. (AAAI 2018), the
double target van Hasselt et al. (AAAI 2016), returns of several steps as in Rainbow (Hessel et al.,
AAAI 2018). Blocked actions are excluded from play and from the target. The policy takes the action
whose quantiles have the largest mean. Observations are stored raw, and normalised by the current
moments when they are drawn.

The replay is not saved: a resumed run first fills it with ``learning_starts`` steps of its policy.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from ms_slam_agents.environments import first_seed, make_venv, opened
from ms_slam_agents.network import BLOCKED, Network, load_parameters
from ms_slam_agents.normalization import Normalization, moment_tensors, restore_moments
from ms_slam_agents.policy_file import Metadata, PolicyFile, Tensors
from ms_slam_agents.sb3_state import optimizer_tensors, restore_adam
from ms_slam_agents.trainers import QrdqnArgs as Args
from ms_slam_agents.trainers import qrdqn as main
from ms_slam_agents.training_run import TrainingRun, read_init, train_run
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch import Tensor
from torch.nn.functional import huber_loss

# -- Replay ------------------------------------------------------------------------------------

Transition = tuple[NDArray[Any], int, float, NDArray[Any], NDArray[np.bool_], float]
"""Observation (k,), action, rewards summed, observation (k,) and mask (n,) after them, and what a
value there is worth: gamma to their number, 0 where the episode ended."""


class Replay:
    """Replay buffer of the latest transitions.

    Args:
        size: number of transitions.
        inputs: length of an observation.
        actions: number of actions.
    """

    def __init__(self, size: int, inputs: int, actions: int) -> None:
        self.columns: list[NDArray[Any]] = [
            np.zeros((size, inputs), np.float32),
            np.zeros(size, np.int64),
            np.zeros(size, np.float32),
            np.zeros((size, inputs), np.float32),
            np.zeros((size, actions), np.bool_),
            np.zeros(size, np.float32),
        ]
        self.size, self.added = size, 0

    def __len__(self) -> int:
        return min(self.size, self.added)

    def add(self, transition: Transition) -> None:
        """Store a transition; when full, it replaces the oldest."""
        values: tuple[Any, ...] = transition
        for column, value in zip(self.columns, values, strict=True):
            column[self.added % self.size] = value
        self.added += 1

    def draw(self, rng: np.random.Generator, count: int) -> list[NDArray[Any]]:
        """Draw ``count`` transitions uniformly, as columns."""
        chosen = rng.integers(len(self), size=count)
        return [column[chosen] for column in self.columns]


class Returns:
    """Makes transitions of several steps from the steps of one environment.

    Args:
        n_step: steps of a transition; fewer at the end of an episode.
        gamma: discount factor.
    """

    def __init__(self, n_step: int, gamma: float) -> None:
        self.n_step, self.gamma = n_step, gamma
        self._open: list[tuple[NDArray[Any], int, float]] = []

    def step(
        self,
        before: tuple[NDArray[Any], int, float],
        after: tuple[NDArray[Any], NDArray[np.bool_]],
        is_over: bool,
        is_terminated: bool,
    ) -> Iterator[Transition]:
        """The transitions that a step completes.

        Args:
            before: observation, action and its reward.
            after: observation and mask, of the same episode.
            is_over: whether the episode ends here.
            is_terminated: whether nothing would have come after it.
        """
        self._open.append(before)
        while self._open and (is_over or len(self._open) == self.n_step):
            total = sum(self.gamma**k * reward for k, (_, _, reward) in enumerate(self._open))
            worth = 0.0 if is_terminated else self.gamma ** len(self._open)
            seen, action, _ = self._open.pop(0)
            yield seen, action, total, *after, worth


# -- Loss --------------------------------------------------------------------------------------


def masked_best(quantiles: Tensor, masks: Tensor) -> Tensor:
    """The possible actions (B,) with the largest mean of quantiles (B, n, Q)."""
    return quantiles.mean(dim=2).masked_fill(~masks, BLOCKED).argmax(dim=1)


def quantile_loss(found: Tensor, wanted: Tensor) -> Tensor:
    """Quantile Huber loss (equation 10 of Dabney et al.) of quantiles (B, Q), mean over B.

    Args:
        found: quantiles at (i + 1/2) / Q.
        wanted: (B, Q') samples of the return.
    """
    count = found.shape[1]
    levels = (torch.arange(count, dtype=found.dtype) + 0.5) / count
    a, b = torch.broadcast_tensors(found[:, :, None], wanted[:, None, :])
    weights = (levels[:, None] - (b < a).to(found.dtype)).abs()
    return (weights * huber_loss(a, b, reduction="none")).mean(dim=2).sum(dim=1).mean()


# -- Run ---------------------------------------------------------------------------------------


class Learner:
    """Network, target and optimiser: all that a gradient step changes.

    Args:
        args: of the training.
        normalization: of observations and returns.
        actions: number of actions.
        file: policy file to resume from, with its optimiser, or to start from.
    """

    def __init__(
        self, args: Args, normalization: Normalization, actions: int, file: PolicyFile | None
    ) -> None:
        self.args, self.normalization = args, normalization
        inputs = len(normalization.obs_rms.mean)
        shape = (inputs, args.hidden, actions, 0, args.candidates, args.quantiles)
        torch.manual_seed(args.seed)
        self.network, self.target = (Network(*shape, image=args.image) for _ in range(2))
        self.optimizer = torch.optim.Adam(self.network.parameters(), args.learning_rate)
        self.updates = 0
        if file:
            load_parameters(self.network, file)
            restore_moments(normalization, file)
        self.target.load_state_dict(self.network.state_dict())
        if file and file.can_resume:
            load_parameters(self.target, file, "target")
            restore_adam(self.optimizer, file.part("optimizer"), self.names)
            self.updates = int(file.part("optimizer")["step"])

    @property
    def names(self) -> list[str]:
        """Of the network's parameters, in order."""
        return [name for name, _ in self.network.named_parameters()]

    @torch.no_grad()
    def targets(self, rewards: Tensor, after: Tensor, masks: Tensor, worth: Tensor) -> Tensor:
        """Samples of the returns (B, Q): the network chooses the action, the target says of it."""
        best = masked_best(self.network.quantiles(after), masks)
        quantiles = self.target.quantiles(after)[torch.arange(len(best)), best]
        return rewards[:, None] + worth[:, None] * quantiles

    def learn(self, batch: Sequence[NDArray[Any]]) -> float:
        """Make a gradient step; return the loss before it."""
        scale = self.normalization
        seen, after = (torch.as_tensor(scale.scaled(batch[i])) for i in (0, 3))
        rewards = torch.as_tensor(batch[2] / np.float32(scale.return_scale))
        actions, masks, worth = (torch.as_tensor(batch[i]) for i in (1, 4, 5))
        wanted = self.targets(rewards, after, masks, worth)
        found = self.network.quantiles(seen)[torch.arange(len(actions)), actions]
        loss = quantile_loss(found, wanted)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self.optimizer.step()
        self.updates += 1
        if self.updates % self.args.target_every == 0:
            self.target.load_state_dict(self.network.state_dict())
        return loss.item()

    def tensors(self) -> Tensors:
        """For a policy file; the state of training is in it once there was a gradient step."""
        found = self.network.tensors() | moment_tensors(self.normalization)
        if not self.updates:
            return found
        target = {
            f"target.{n.removeprefix('policy.')}": v for n, v in self.target.tensors().items()
        }
        return found | target | optimizer_tensors(self.names, self.optimizer.state_dict())


class Run(TrainingRun):
    """A training run.

    Args:
        args: of the training.
        venv: environments, not normalised.
        file: policy file to resume from, if any.

    Raises:
        InputError: a policy to begin with that is no QR-DQN's.
    """

    (algorithm,) = Args.algorithms

    def __init__(self, args: Args, venv: VecEnv, file: PolicyFile | None) -> None:
        super().__init__(args, venv.observation_space, venv.action_space, file)
        self.args, self.venv = args, venv
        begun = file or (read_init(args).untrained() if args.init else None)
        normalization = Normalization(self.inputs, self.actions, args.candidates, args.gamma)
        if begun:
            begun.metadata.check_sizes(args.init or args.out, self.inputs, self.actions)
        self.learner = Learner(args, normalization, self.actions, begun)
        self.rng = np.random.default_rng([args.seed, self.steps])
        self.replay = Replay(args.buffer_size, self.inputs, self.actions)
        self.returns = [Returns(args.n_step, args.gamma) for _ in range(venv.num_envs)]
        venv.seed(first_seed(args.seed, self.steps))
        self.sums = np.zeros(venv.num_envs)
        self.played = 0
        """Steps since this run began."""
        self.ended: list[dict[str, float]] = []
        """Return and length of the episodes that ended since the network was last saved."""

    def tensors(self) -> Tensors:
        """See the base class."""
        return self.learner.tensors()

    def metadata(self) -> Metadata:
        """See the base class."""
        return replace(super().metadata(), quantiles=self.args.quantiles)

    @property
    def epsilon(self) -> float:
        """Current share of random actions."""
        args = self.args
        done = self.steps / max(1.0, args.exploration * args.total_timesteps)
        return max(args.epsilon, 1 - (1 - args.epsilon) * done)

    def advance(self, stop: Callable[[], bool]) -> dict[str, float] | None:
        """Play ``save_every`` steps, learning after every ``train_every``."""
        args, losses = self.args, []
        if not self.played:  # not before: the environments are told of their stage first
            self.seen = np.asarray(self.venv.reset())
            self.learner.normalization.obs_rms.update(self.seen)
        until = min(self.steps + args.save_every, args.total_timesteps)
        while self.steps < until:
            if stop():
                return None
            before = self.played // args.train_every
            self._step()
            if self.played < args.learning_starts or not len(self.replay):  # n steps fill it
                continue
            for _ in range(self.played // args.train_every - before):
                losses.append(self.learner.learn(self.replay.draw(self.rng, args.batch_size)))
        # As the other trainers count: how often the network has seen what it was shown.
        self.epochs = math.ceil(self.learner.updates * args.batch_size / self.steps)
        said = {"loss": float(np.mean(losses))} if losses else {}
        for name, key in (("return", "r"), ("episode_length", "l")) if self.ended else ():
            said[name] = float(np.mean([episode[key] for episode in self.ended]))
        self.ended = []
        return said | {"epsilon": self.epsilon, "replay": float(len(self.replay))}

    def _step(self) -> None:
        """A step of each environment, into the replay."""
        venv, normalization = self.venv, self.learner.normalization
        masks = np.stack(venv.env_method("action_masks"))
        actions = self._act(masks)
        seen, rewards, ends, infos = venv.step(actions)
        after = np.array(seen)
        normalization.obs_rms.update(after)
        self.sums = normalization.see_rewards(self.sums, rewards, ends)
        for i, info in enumerate(infos):
            then = (info["terminal_observation"] if ends[i] else after[i], info["action_mask"])
            is_terminated = bool(ends[i] and not info["TimeLimit.truncated"])
            step = (self.seen[i], int(actions[i]), float(rewards[i]))
            for transition in self.returns[i].step(step, then, bool(ends[i]), is_terminated):
                self.replay.add(transition)
        self.ended += [info["episode"] for info in infos if "episode" in info]
        self.seen = after
        self.steps += venv.num_envs
        self.played += venv.num_envs

    @torch.no_grad()
    def _act(self, masks: NDArray[np.bool_]) -> NDArray[np.int64]:
        """The best possible actions (B,), or, by chance, any possible ones."""
        scaled = torch.as_tensor(self.learner.normalization.scaled(self.seen))
        best = masked_best(self.learner.network.quantiles(scaled), torch.as_tensor(masks)).numpy()
        anyhow = [self.rng.choice(np.flatnonzero(mask)) for mask in masks]
        return np.where(self.rng.random(len(best)) < self.epsilon, anyhow, best)


def make_run(args: Args, file: PolicyFile | None, stack: ExitStack) -> Run:
    """Make a run and its environments."""
    venv = stack.enter_context(opened(make_venv(args, "train")))
    return Run(args, VecMonitor(venv), file)


def train(args: Args) -> int:
    """Train as ``args`` say; return the exit code; see `train_run`."""
    return train_run(args, Run.algorithm, make_run)


if __name__ == "__main__":
    sys.exit(main())
