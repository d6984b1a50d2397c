"""PPO with action masks, an optional memory, and a pull towards an initial policy.

    ms-slam train ppo --init runs/imitation/best.safetensors --observation map --out runs/ppo

From top to bottom: rollout, advantages, update, run; the network is in ``network.py``. Proximal
policy optimisation is Schulman et al. (2017); masked logits as in sb3-contrib; the memory is a
gated recurrent unit whose state at the start of every chunk of a rollout is kept (as in recurrent
PPO, stale by one update at most). The pull is the divergence from the initial policy's
probabilities, with decreasing weight: it keeps an agent that starts as good as a planner from
unlearning before its value function is accurate.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from ms_slam_agents.environments import first_seed, make_venv, opened
from ms_slam_agents.network import Network, load_parameters
from ms_slam_agents.normalization import (
    Normalization,
    PooledMoments,
    moment_tensors,
    restore_moments,
)
from ms_slam_agents.policy_file import Metadata, PolicyFile, Tensors
from ms_slam_agents.sb3_state import optimizer_tensors, restore_adam
from ms_slam_agents.trainers import PpoArgs as Args
from ms_slam_agents.trainers import ppo as main
from ms_slam_agents.training_run import TrainingRun, read_init, train_run
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import Tensor, nn
from torch.nn.functional import kl_div, mse_loss

# -- Experience --------------------------------------------------------------------------------


@dataclass
class Rollout:
    """T steps of B environments, as tensors (T, B, ...)."""

    seen: Tensor
    masks: Tensor
    begins: Tensor
    memory: Tensor
    """Before each step."""
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    rewards: Tensor
    pulled_to: Tensor
    """Probabilities of the first policy; (T, B, 0) without one."""
    advantages: Tensor = field(default_factory=lambda: torch.empty(0))

    def find_advantages(self, last_values: Tensor, ended: Tensor, args: Args) -> None:
        """Generalised advantage estimation (Schulman et al., 2016); ``ended`` (B,) after the last
        step."""
        self.advantages = torch.zeros_like(self.rewards)
        advantage = torch.zeros_like(last_values)
        following, goes_on = last_values, 1 - ended
        for t in reversed(range(len(self.rewards))):
            error = self.rewards[t] + args.gamma * following * goes_on - self.values[t]
            advantage = error + args.gamma * args.gae_lambda * goes_on * advantage
            self.advantages[t] = advantage
            following, goes_on = self.values[t], 1 - self.begins[t]

    def chunks(self, length: int) -> dict[str, Tensor]:
        """Everything as (length, chunks, ...): pieces of ``length`` steps of one environment."""
        count = len(self.rewards) // length

        def cut(values: Tensor) -> Tensor:
            whole = values[: count * length].unflatten(0, (count, length))
            return whole.transpose(0, 1).flatten(1, 2)

        return {name: cut(values) for name, values in vars(self).items()}


class FirstPolicy:
    """The initial policy that pulls, with its own normalisation and memory.

    Args:
        network: with its parameters.
        normalization: its own, which does not move with what is met.
        num_envs: environments at once.
    """

    def __init__(self, network: Network, normalization: Normalization, num_envs: int) -> None:
        self.network, self.normalization = network, normalization
        self.memory = torch.zeros(num_envs, network.width)

    def probabilities(self, observations: Any, begins: Tensor, masks: Tensor) -> Tensor:
        """Probabilities (B, n) of the actions, given raw observations (B, k)."""
        seen = torch.as_tensor(self.normalization.scaled(observations))
        self.memory = self.network.remember(seen, self.memory, begins)
        return self.network(seen, self.memory, masks)[0].exp()


class Player:
    """Plays the environments with the current network.

    Args:
        venv: normalised environments.
        network: that chooses.
        args: of the training.
        first: the policy that pulls, if one does.
        steps: made before.
    """

    seen: Tensor

    def __init__(
        self,
        venv: VecNormalize,
        network: Network,
        args: Args,
        first: FirstPolicy | None = None,
        steps: int = 0,
    ) -> None:
        self.venv, self.network, self.args, self.first = venv, network, args, first
        self.generator = torch.Generator().manual_seed(args.seed + steps)
        venv.seed(first_seed(args.seed, steps))
        self.has_begun = False
        self.begins = torch.ones(venv.num_envs)
        self.memory = torch.zeros(venv.num_envs, network.width)
        self.returns: list[float] = []
        """Of the episodes that ended in the last rollout, as the environments reward them."""
        self.lengths: list[int] = []
        """Of these, in steps."""

    @torch.no_grad()
    def play(self, steps: int, stop: Any) -> Rollout | None:
        """Play a rollout; return None if ``stop()`` ended it early."""
        rows: list[tuple[Tensor, ...]] = []
        self.returns, self.lengths = [], []
        if not self.has_begun:  # not before: the environments are told of their stage first
            self.seen, self.has_begun = _tensor(self.venv.reset()), True
        for _ in range(steps):
            if stop():
                return None
            masks = torch.as_tensor(np.stack(self.venv.env_method("action_masks")))
            before, begins, seen = self.memory, self.begins, self.seen
            self.memory = self.network.remember(seen, before, begins)
            log_probs, values = self.network(seen, self.memory, masks)
            actions = torch.multinomial(log_probs.exp(), 1, generator=self.generator)[:, 0]
            pulled_to = torch.zeros(len(actions), 0)
            if self.first is not None:
                as_met = self.venv.get_original_obs()
                pulled_to = self.first.probabilities(as_met, begins, masks)
            observations, rewards, dones, infos = self.venv.step(actions.numpy())
            chosen = log_probs.gather(1, actions[:, None])[:, 0]
            gained = _tensor(rewards) + self._cut_off(dones, infos)
            rows.append((seen, masks, begins, before, actions, chosen, values, gained, pulled_to))
            self.seen, self.begins = _tensor(observations), _tensor(dones)
            ended = [info["episode"] for info in infos if "episode" in info]
            self.returns += [episode["r"] for episode in ended]
            self.lengths += [episode["l"] for episode in ended]
        rollout = Rollout(*(torch.stack(column) for column in zip(*rows, strict=True)))
        memory = self.network.remember(self.seen, self.memory, self.begins)
        _, last = self.network(self.seen, memory, torch.ones_like(masks))
        rollout.find_advantages(last, self.begins, self.args)
        return rollout

    def _cut_off(self, dones: Any, infos: list[dict[str, Any]]) -> Tensor:
        """The value at the last observation of episodes that the time limit ended."""
        rest = torch.zeros(len(dones))
        for i in np.flatnonzero(dones):
            if infos[i].get("TimeLimit.truncated"):
                there = _tensor(infos[i]["terminal_observation"])[None]  # normalised already
                memory = self.network.remember(there, self.memory[i : i + 1], torch.zeros(1))
                possible = torch.ones(1, self.network.actions, dtype=torch.bool)
                rest[i] = self.args.gamma * self.network(there, memory, possible)[1][0]
        return rest


def _tensor(array: Any) -> Tensor:
    return torch.as_tensor(np.asarray(array), dtype=torch.float32)


# -- Update ------------------------------------------------------------------------------------


def update(
    network: Network,
    optimizer: torch.optim.Optimizer,
    rollout: Rollout,
    args: Args,
    pull: float,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Learn from a rollout; return the mean loss terms and the change of the policy.

    ``approx_kl`` (of the last epoch), ``clip_fraction`` and ``explained_variance`` are defined as
    in Stable-Baselines3.
    """
    length = min(args.chunk, len(rollout.rewards)) if network.width else 1
    data = rollout.chunks(length)
    count = data["rewards"].shape[1]
    per_batch = max(1, args.batch_size // length)
    parts: list[list[float]] = []
    for _ in range(args.n_epochs):
        order = rng.permutation(count)
        for chosen in np.array_split(order, math.ceil(count / per_batch)):
            batch = {name: values[:, torch.as_tensor(chosen)] for name, values in data.items()}
            losses = _losses(network, batch, args)
            weights = (1.0, args.value_weight, -args.ent_coef, pull)
            loss = sum(w * part for w, part in zip(weights, losses[:4], strict=True))
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimizer.step()
            parts.append([part.item() for part in losses])
    names = ("policy_loss", "value_loss", "entropy", "pull", "approx_kl", "clip_fraction")
    said = dict(zip(names, np.mean(parts, axis=0).tolist(), strict=True))
    said["approx_kl"] = float(np.mean([part[4] for part in parts[-len(parts) // args.n_epochs :]]))
    values, advantages = rollout.values.flatten().numpy(), rollout.advantages.flatten().numpy()
    return said | {"explained_variance": explained_variance(values, values + advantages)}


def _losses(network: Network, batch: dict[str, Tensor], args: Args) -> tuple[Tensor, ...]:
    """Policy, value, entropy and divergence from the first policy, of chunks (L, C, ...).

    After these, of which the loss consists, the divergence from the policy that played (Schulman's
    estimate) and the share of the steps whose ratio is clipped.
    """
    log_probs, values = network.along(
        batch["seen"], batch["memory"][0], batch["begins"], batch["masks"]
    )
    flat = {name: part.flatten(0, 1) for name, part in batch.items()}
    advantages = flat["advantages"]
    targets = advantages + flat["values"]
    if len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    log_ratio = log_probs.gather(1, flat["actions"][:, None])[:, 0] - flat["log_probs"]
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - args.clip_range, 1 + args.clip_range)
    policy = -torch.min(ratio * advantages, clipped * advantages).mean()
    probabilities = log_probs.exp()
    entropy = -(probabilities * log_probs.masked_fill(~flat["masks"], 0)).sum(dim=1).mean()
    pulled_to = flat["pulled_to"]
    pull = kl_div(log_probs, pulled_to, reduction="batchmean") if pulled_to.numel() else 0 * policy
    went, is_clipped = ratio - 1 - log_ratio, (ratio - 1).abs() > args.clip_range
    measures = went.detach().mean(), is_clipped.float().mean()
    return policy, mse_loss(values, targets), entropy, pull, *measures


# -- Run ---------------------------------------------------------------------------------------


class Run(TrainingRun):
    """A training run.

    Args:
        args: of the training.
        venv: normalised environments.
        file: policy file to resume from, if any.
    """

    (algorithm,) = Args.algorithms

    def __init__(self, args: Args, venv: VecNormalize, file: PolicyFile | None) -> None:
        super().__init__(args, venv.observation_space, venv.action_space, file)
        self.args, self.venv = args, venv
        torch.manual_seed(args.seed)
        if args.candidates:
            venv.obs_rms = PooledMoments(self.inputs, self.actions, args.candidates)
        self.network = self._network()
        self.optimizer = torch.optim.Adam(self.network.parameters(), args.learning_rate, eps=1e-5)
        init = read_init(args) if args.init and (file is None or args.pull) else None
        if init:
            init.metadata.check_sizes(args.init, self.inputs, self.actions)
        begun = file or init
        if begun:
            restore_moments(venv, begun)
            load_parameters(self.network, begun)
        if file and file.can_resume:
            restore_adam(self.optimizer, file.part("optimizer"), self._names)
        first = self._first_policy(init) if init and args.pull else None
        self.player = Player(venv, self.network, args, first, self.steps)
        self.rng = np.random.default_rng([args.seed, self.steps])

    def _network(self) -> Network:
        args = self.args
        layers = (self.inputs, args.hidden, self.actions, args.memory, args.candidates)
        return Network(*layers, image=args.image)

    @property
    def _names(self) -> list[str]:
        return [name for name, _ in self.network.named_parameters()]

    def _first_policy(self, file: PolicyFile) -> FirstPolicy:
        """The initial policy that pulls, from ``init``."""
        args, network = self.args, self._network()
        load_parameters(network, file)
        normalization = Normalization(self.inputs, self.actions, args.candidates, args.gamma)
        restore_moments(normalization, file)
        return FirstPolicy(network, normalization, self.venv.num_envs)

    def tensors(self) -> Tensors:
        """See the base class."""
        state = optimizer_tensors(self._names, self.optimizer.state_dict())
        return self.network.tensors() | state | moment_tensors(self.venv)

    def metadata(self) -> Metadata:
        """See the base class."""
        return replace(super().metadata(), memory=self.args.memory)

    def advance(self, stop: Callable[[], bool]) -> dict[str, float] | None:
        """Play a rollout and learn from it."""
        args = self.args
        rollout = self.player.play(args.n_steps, stop)
        if rollout is None:
            return None
        left = 1 - self.steps / args.total_timesteps
        self.optimizer.param_groups[0]["lr"] = args.learning_rate * left
        pull = args.pull * max(0.0, 1 - self.steps / args.pull_steps)
        said = update(self.network, self.optimizer, rollout, args, pull, self.rng)
        self.steps += rollout.rewards.numel()
        self.epochs += args.n_epochs
        if self.player.returns:
            said["return"] = float(np.mean(self.player.returns))
            said["episode_length"] = float(np.mean(self.player.lengths))
        return said


def make_run(args: Args, file: PolicyFile | None, stack: ExitStack) -> Run:
    """Make a run and its environments."""
    venv = stack.enter_context(opened(make_venv(args, "train")))
    return Run(args, VecNormalize(VecMonitor(venv), gamma=args.gamma), file)


def train(args: Args) -> int:
    """Train as ``args`` say; return the exit code; see `train_run`."""
    return train_run(args, Run.algorithm, make_run)


if __name__ == "__main__":
    sys.exit(main())
