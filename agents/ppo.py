"""PPO with action masks, a memory if asked for, and a pull towards a policy to begin with.

    ms-slam train ppo --init runs/imitation/best.safetensors --observation map --out runs/ppo

One file from top to bottom: network, rollout, advantages, update, run. Proximal policy optimisation
is Schulman et al. (2017); masked logits as in sb3-contrib; the memory is a gated recurrent unit
whose state at the start of every chunk of a rollout is kept (as in recurrent PPO, stale by one
update at most). The pull is the divergence from the first policy's probabilities, weighed less and
less: it keeps an agent that begins as good as a planner from unlearning that before its value
function can tell good from bad.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ms_slam_agents.evaluation import references
from ms_slam_agents.learning_curve import Curve, read_curve
from ms_slam_agents.options import (
    KEPT,
    Problem,
    check_kept,
    check_new,
    check_steps_left,
    numbers_of_candidates,
    parse_for_task,
)
from ms_slam_agents.policy_file import (
    Metadata,
    PolicyFile,
    encoded_width,
    read_policy,
    write_policy,
)
from ms_slam_agents.sb3_state import (
    PooledMoments,
    moment_tensors,
    optimizer_tensors,
    restore_adam,
    restore_moments,
)
from ms_slam_agents.supervisor import LATEST
from ms_slam_agents.train_sb3 import VALIDATION_SEED, check_problem, env_options, make_venv
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor, nn
from torch.nn.functional import kl_div, log_softmax, mse_loss
from tqdm import tqdm

from ms_slam_env.command_line import exit_code
from ms_slam_env.config import bounded
from ms_slam_env.errors import InputError
from ms_slam_env.interrupts import kept
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import RESULTS

_BLOCKED = -1e9  # logit of a blocked action; -inf would make NaN of its entropy


@dataclass(frozen=True)
class Args(Problem):
    """Train with masked PPO, with memory or without; these options are the command line.

    Attributes:
        init: policy file to begin with, as of ``ms-slam train imitation``.
        pull: weight of the divergence from the first policy, at the start; it falls to 0 linearly.
        pull_steps: environment steps until then.
        memory: width of the recurrent unit; 0: the policy sees the present observation alone.
        chunk: steps over which gradients go back through the memory.
        total_timesteps: environment steps, all runs of a resumed training together.
        minutes: stop this run after training for so much wall-clock time, evaluations left out.
        eval_every: environment steps between evaluations; 0: only first and last.
        references: play the validation episodes with random walk, standing still and the greedy
            planner too, before training.
        n_steps: steps of each environment between updates.
        batch_size: of the gradient steps, in steps.
        n_epochs: passes over the data of one update.
        learning_rate: of Adam; it falls to 0 linearly.
        gamma: discount factor.
        gae_lambda: trade-off between bias and variance of the advantages.
        ent_coef: weight of the entropy bonus.
        clip_range: of PPO's objective.
        value_weight: of the error of the value in the loss.
        hidden: width of the two hidden layers.
    """

    out: Path = Path("runs/ppo")
    init: Path | None = None
    pull: float = bounded(0.0, 0, 1000)
    pull_steps: int = bounded(100_000, 1, 1_000_000_000)
    memory: int = bounded(0, 0, 4096)
    chunk: int = bounded(16, 1, 10_000)
    total_timesteps: int = bounded(200_000, 2, 1_000_000_000)
    minutes: float | None = bounded(None, 0, 1_000_000)
    eval_every: int = bounded(20_000, 0, 1_000_000_000)
    references: bool = False
    n_steps: int = bounded(512, 2, 1_000_000)
    batch_size: int = bounded(256, 2, 1_000_000)
    n_epochs: int = bounded(6, 1, 1000)
    learning_rate: float = bounded(2.5e-4, 0, 1)
    gamma: float = bounded(0.98, 0, 1)
    gae_lambda: float = bounded(0.95, 0, 1)
    ent_coef: float = bounded(0.003, 0, 1)
    clip_range: float = bounded(0.2, 0, 1)
    value_weight: float = bounded(0.5, 0, 1000)
    hidden: int = bounded(256, 1, 4096)


# -- Network -----------------------------------------------------------------------------------


class Network(nn.Module):
    """Two hidden layers for the policy and two for the value, behind a memory if there is one.

    With ``candidates`` numbers of each action at the end of an observation, one encoder looks at
    each action's, the layers see the state and the mean and the largest of what it makes of them,
    and one score is given for each: in another order the actions have the same probabilities.

    The names of the parameters are Stable-Baselines3's, ``memory.*``, ``encoder.*``, ``score.*``.
    """

    def __init__(
        self, inputs: int, hidden: int, actions: int, memory: int, candidates: int = 0
    ) -> None:
        super().__init__()
        self.width, self.actions = memory, actions
        self.num_state = inputs - actions * candidates
        encoded = encoded_width(hidden)
        seen = self.num_state + 2 * encoded if candidates else inputs
        self.memory = nn.GRUCell(seen, memory) if memory else None

        def layers() -> nn.Sequential:
            return _layers(seen + memory, hidden, hidden)

        self.encoder = _layers(candidates, encoded, encoded) if candidates else None
        self.mlp_extractor = nn.ModuleDict({"policy_net": layers(), "value_net": layers()})
        self.score = nn.Linear(encoded + hidden, encoded) if candidates else None
        self.action_net = nn.Linear(encoded, 1) if candidates else nn.Linear(hidden, actions)
        self.value_net = nn.Linear(hidden, 1)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                gain = {self.action_net: 0.01, self.value_net: 1.0}.get(module, math.sqrt(2))
                nn.init.orthogonal_(module.weight, gain)
                nn.init.zeros_(module.bias)

    def remember(self, seen: Tensor, memory: Tensor, begins: Tensor) -> Tensor:
        """The memory (B, M) after observations (B, k); empty where an episode ``begins`` (B,)."""
        if self.memory is None:
            return memory
        return self.memory(self._look(seen)[0], memory * (1 - begins[:, None]))

    def _look(self, seen: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the layers see (B, k), and the candidates (B, n, E) as encoded, if there are any."""
        if self.encoder is None:
            return seen, None
        encoded = self.encoder(seen[:, self.num_state :].unflatten(1, (self.actions, -1)))
        parts = [seen[:, : self.num_state], encoded.mean(dim=1), encoded.amax(dim=1)]
        return torch.cat(parts, dim=1), encoded

    def forward(self, seen: Tensor, memory: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probabilities (B, n) of the actions, and values (B,)."""
        seen, encoded = self._look(seen)
        x = torch.cat([seen, memory], dim=1)
        whole = self.mlp_extractor["policy_net"](x)
        if self.score is not None and encoded is not None:
            beside = whole[:, None].expand(-1, self.actions, -1)
            whole = torch.tanh(self.score(torch.cat([encoded, beside], dim=2)))
        logits = self.action_net(whole).reshape(masks.shape)
        values = self.value_net(self.mlp_extractor["value_net"](x))
        return log_softmax(logits.masked_fill(~masks, _BLOCKED), dim=1), values.flatten()


def _layers(inputs: int, first: int, second: int) -> nn.Sequential:
    """Two layers, tanh after each."""
    return nn.Sequential(nn.Linear(inputs, first), nn.Tanh(), nn.Linear(first, second), nn.Tanh())


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


class Player:
    """Plays the environments with the network as it is.

    Args:
        venv: normalised environments.
        network: that chooses.
        args: of the training.
        first: the policy that pulls, if one does.
        seed: of the draws.
    """

    def __init__(
        self, venv: VecNormalize, network: Network, args: Args, first: Network | None, seed: int
    ) -> None:
        self.venv, self.network, self.args, self.first = venv, network, args, first
        self.generator = torch.Generator().manual_seed(seed)
        venv.seed(seed)
        self.seen = _tensor(venv.reset())
        self.begins = torch.ones(venv.num_envs)
        self.memory = torch.zeros(venv.num_envs, network.width)
        self.infos: list[dict[str, Any]] = []

    @torch.no_grad()
    def play(self, steps: int, stop: Any) -> Rollout | None:
        """A rollout; None where ``stop()`` says so before its end."""
        rows: list[tuple[Tensor, ...]] = []
        self.infos = []
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
                pulled_to = self.first(seen, before[:, :0], masks)[0].exp()
            observations, rewards, dones, infos = self.venv.step(actions.numpy())
            chosen = log_probs.gather(1, actions[:, None])[:, 0]
            gained = _tensor(rewards) + self._cut_off(dones, infos)
            rows.append((seen, masks, begins, before, actions, chosen, values, gained, pulled_to))
            self.seen, self.begins = _tensor(observations), _tensor(dones)
            self.infos += infos
        rollout = Rollout(*(torch.stack(column) for column in zip(*rows, strict=True)))
        memory = self.network.remember(self.seen, self.memory, self.begins)
        _, last = self.network(self.seen, memory, torch.ones_like(masks))
        rollout.find_advantages(last, self.begins, self.args)
        return rollout

    def _cut_off(self, dones: Any, infos: list[dict[str, Any]]) -> Tensor:
        """What was still to come where the time limit ended an episode: the value there."""
        rest = torch.zeros(len(dones))
        for i in np.flatnonzero(dones):
            if infos[i].get("TimeLimit.truncated"):
                there = _tensor(self.venv.normalize_obs(infos[i]["terminal_observation"]))[None]
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
    """Learn from a rollout; means of the parts of the loss."""
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
            loss = sum(w * part for w, part in zip(weights, losses, strict=True) if w)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[union-attr]
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimizer.step()
            parts.append([part.item() for part in losses])
    names = ("policy_loss", "value_loss", "entropy", "pull")
    return dict(zip(names, np.mean(parts, axis=0).tolist(), strict=True))


def _losses(network: Network, batch: dict[str, Tensor], args: Args) -> tuple[Tensor, ...]:
    """Policy, value, entropy and divergence from the first policy, of chunks (L, C, ...)."""
    memory, rows = batch["memory"][0], []
    for t in range(len(batch["rewards"])):
        memory = network.remember(batch["seen"][t], memory, batch["begins"][t])
        rows.append(network(batch["seen"][t], memory, batch["masks"][t]))
    log_probs, values = (torch.cat(column) for column in zip(*rows, strict=True))
    flat = {name: part.flatten(0, 1) for name, part in batch.items()}
    advantages = flat["advantages"]
    targets = advantages + flat["values"]
    if len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    ratio = (log_probs.gather(1, flat["actions"][:, None])[:, 0] - flat["log_probs"]).exp()
    clipped = ratio.clamp(1 - args.clip_range, 1 + args.clip_range)
    policy = -torch.min(ratio * advantages, clipped * advantages).mean()
    probabilities = log_probs.exp()
    entropy = -(probabilities * log_probs.masked_fill(~flat["masks"], 0)).sum(dim=1).mean()
    pulled_to = flat["pulled_to"]
    pull = kl_div(log_probs, pulled_to, reduction="batchmean") if pulled_to.numel() else 0 * policy
    return policy, mse_loss(values, targets), entropy, pull


# -- Run ---------------------------------------------------------------------------------------


class Run:
    """A training run: what it has learnt, and what of it is on disk.

    Args:
        args: of the training.
        venv: normalised environments.
        validation: environments of ``FixedEpisodes``.
        file: to go on from, if there is one.
    """

    def __init__(
        self, args: Args, venv: VecNormalize, validation: Any, file: PolicyFile | None
    ) -> None:
        self.args, self.venv, self.validation = args, venv, validation
        torch.manual_seed(args.seed)
        inputs, actions = venv.observation_space.shape[0], int(venv.action_space.n)  # type: ignore
        candidates = numbers_of_candidates(args)
        if candidates:
            venv.obs_rms = PooledMoments(inputs, actions, candidates)
        self.network = Network(inputs, args.hidden, actions, args.memory, candidates)
        self.optimizer = torch.optim.Adam(self.network.parameters(), args.learning_rate, eps=1e-5)
        self.first = _first_policy(args, inputs, actions)
        begun = file or (read_policy(args.init) if args.init else None)
        if begun:
            restore_moments(venv, begun)
        if begun and (file or not args.memory):
            self.network.load_state_dict(_parameters(begun))
        self.steps = file.metadata.timesteps if file else 0
        self.epochs = file.metadata.epochs if file else 0
        self.minutes = file.metadata.minutes if file else 0.0
        if file and file.can_resume:
            names = [name for name, _ in self.network.named_parameters()]
            restore_adam(self.optimizer, file.part("optimizer"), names)
        self.provenance = provenance()

    def file(self) -> PolicyFile:
        """The policy as it is now, with the state of the optimiser."""
        args, network = self.args, self.network
        metadata = Metadata(
            algorithm="masked_ppo",
            env_id=args.env_id,
            env_options=env_options(args),
            observation=args.observation,
            inputs=self.venv.observation_space.shape[0],  # type: ignore[index]
            hidden=(args.hidden, args.hidden),
            actions=(network.actions,),
            memory=args.memory,
            candidates=numbers_of_candidates(args),
            timesteps=self.steps,
            epochs=self.epochs,
            minutes=self.minutes,
            options=to_plain(asdict(args)),
            provenance=self.provenance,
        )
        names = [name for name, _ in network.named_parameters()]
        tensors = {f"policy.{n}": p.detach().numpy() for n, p in network.named_parameters()}
        tensors |= optimizer_tensors(names, self.optimizer.state_dict())
        return PolicyFile(metadata, tensors | moment_tensors(self.venv))

    def learn(self, curve: Curve, stop: Any) -> Curve:
        """Play and update until the steps are made or ``stop`` says so."""
        args = self.args
        player = Player(self.venv, self.network, args, self.first, args.seed + self.steps)
        rng = np.random.default_rng([args.seed, self.steps])
        bar = tqdm(total=args.total_timesteps, initial=self.steps, unit="step", smoothing=0.1)
        if not curve.points:
            curve = self.judge(curve)
        begun, judged = time.monotonic(), self.steps
        while self.steps < args.total_timesteps and not stop(self.minutes):
            rollout = player.play(args.n_steps, lambda: stop(None))
            if rollout is None:
                break
            left = 1 - self.steps / args.total_timesteps
            self.optimizer.param_groups[0]["lr"] = args.learning_rate * left
            pull = args.pull * max(0.0, 1 - self.steps / args.pull_steps)
            said = update(self.network, self.optimizer, rollout, args, pull, rng)
            self.steps += rollout.rewards.numel()
            self.epochs += args.n_epochs
            self.minutes += (time.monotonic() - begun) / 60
            bar.update(rollout.rewards.numel())
            bar.set_postfix({name: f"{value:.3g}" for name, value in said.items()})
            ends = args.eval_every and self.steps // args.eval_every > judged // args.eval_every
            write_policy(args.out / LATEST, self.file())
            if ends or self.steps >= args.total_timesteps:
                curve, judged = self.judge(curve), self.steps
            begun = time.monotonic()
        bar.close()
        return curve

    def judge(self, curve: Curve) -> Curve:
        """Evaluate, and keep what is best so far."""
        file = self.file().without_optimizer()
        point = curve.judge(file, self.validation, self.args.out, self.args.deterministic_eval)
        tqdm.write(
            f"{self.steps} steps, {self.minutes:.1f} min: validation return {point['return']:.2f}, "
            f"mapped {point['mapped_area_m2']:.1f} m2, ended early {point['terminated']:.0%}"
        )
        return curve


def _first_policy(args: Args, inputs: int, actions: int) -> Network | None:
    """The policy of ``init`` as it pulls; None without a pull.

    Raises:
        InputError: no policy, or one that does not fit.
    """
    if args.init is None:
        return None
    file = read_policy(args.init)
    known = file.metadata
    for name, own in (("env_id", args.env_id), ("observation", args.observation)):
        if getattr(known, name) != own:
            raise InputError(f"{args.init} is for {name} {getattr(known, name)!r}, not {own!r}")
    if known.memory or tuple(known.actions) != (actions,) or known.inputs != inputs:
        raise InputError(f"{args.init} is a policy with a memory, or of other actions")
    if known.candidates != numbers_of_candidates(args):
        raise InputError(f"{args.init} does not look at the candidates one by one")
    if tuple(known.hidden) != (args.hidden,) * 2:
        raise InputError(f"{args.init} has layers of {known.hidden}: give --hidden that")
    if not args.pull:
        return None
    first = Network(inputs, args.hidden, actions, 0, known.candidates)
    first.load_state_dict(_parameters(file))
    return first


def _parameters(file: PolicyFile) -> dict[str, Tensor]:
    return {name: torch.from_numpy(value) for name, value in file.part("policy").items()}


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
    known = file.metadata
    if known.algorithm != "masked_ppo":
        raise InputError(f"{path} is of {known.algorithm}, not of masked_ppo")
    kept_options = {*KEPT, "memory"} - {"algorithm"}
    check_kept(path, known.options, args, sorted(kept_options))
    check_steps_left(path, known.timesteps, args.total_timesteps)
    return file


def train(args: Args) -> int:
    """Train as ``args`` say; return the exit status, 130 after an interrupt.

    Raises:
        InputError: bad options, or nothing to train.
    """
    torch.set_num_threads(1)
    file = load_run(args)
    if args.init:
        read_policy(args.init)  # refused before anything is written
    check_problem(args)
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
    validation = make_venv(args, "validation", seeds)
    venv = VecNormalize(make_venv(args, "train"), gamma=args.gamma)
    signals: list[int] = []

    before = file.metadata.minutes if file else 0.0

    def stop(minutes: float | None) -> bool:
        if minutes is None or args.minutes is None:
            return bool(signals)
        return bool(signals) or minutes - before >= args.minutes

    handlers = {
        number: signal.signal(number, lambda number, _: signals.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        run = Run(args, venv, validation, file)
        args.out.mkdir(parents=True, exist_ok=True)
        curve = Curve(args.eval_episodes, config=to_plain(asdict(args)))
        if file and (args.out / RESULTS).is_file():
            curve.points = read_curve(args.out / RESULTS).points
        elif args.references:
            curve.references = references(validation, args.eval_episodes)
        with kept(f"what was trained before the last update is kept in {args.out}"):
            run.learn(curve, stop)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        venv.close()
        validation.close()
    print(f"{'interrupted' if signals else 'done'}: {run.steps} steps, policy in {args.out}")
    return 130 if signals else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, 2 or 130."""
    words = list(sys.argv[1:] if argv is None else argv)
    prog = "ms-slam train ppo"
    return exit_code(lambda: train(parse_for_task(Args, words, prog, "ppo")), prog)


if __name__ == "__main__":
    sys.exit(main())
