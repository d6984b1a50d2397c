"""The network that imitates a planner, and its training batches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from ms_slam_agents.demonstrations import Demonstration
from ms_slam_agents.network import Network, load_parameters
from ms_slam_agents.normalization import Normalization, moment_tensors, restore_moments
from ms_slam_agents.policy_file import PolicyFile
from ms_slam_agents.trainers import ImitationArgs as Args
from ms_slam_agents.training_run import metadata_of

from ms_slam_env.report.provenance import provenance


class Student:
    """The network that learns, with its normalisation.

    Args:
        args: options of the training.
        demonstrations: of the first round; they determine the normalisation.
        file: policy file to resume from.
        epochs: number of epochs done before.

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
        self.normalization = Normalization(self.inputs, self.actions, args.candidates, args.gamma)
        if file:
            restore_moments(self.normalization, file)
        else:
            seen = np.concatenate([d.observations for d in demonstrations])
            self.normalization.obs_rms.update(seen.astype(np.float64))
            sums = np.concatenate([d.returns(args.gamma) for d in demonstrations])
            self.normalization.ret_rms.update(sums)
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

    def fit(self, demonstrations: Sequence[Demonstration]) -> dict[str, float]:
        """Learn from all episodes; return the final loss and probability of its choices.

        The loss is the cross entropy to the teacher's preferences.
        """
        args = self.args
        data = Batches(demonstrations, args, np.random.default_rng([args.seed, self.epochs]))
        optimizer = torch.optim.Adam(self.network.parameters(), lr=args.learning_rate)
        said: list[tuple[float, float]] = []
        for k, (observations, masks, is_step, preferences, returns) in enumerate(data):
            optimizer.param_groups[0]["lr"] = args.learning_rate * (1 - k / len(data))
            seen = torch.as_tensor(self.normalization.scaled(observations))
            can = torch.as_tensor(masks)
            empty, begins = torch.zeros(seen.shape[1], args.memory), torch.zeros(seen.shape[:2])
            log_probs, values = self.network.along(seen, empty, begins, can)
            log_probs = log_probs.masked_fill(~can.flatten(0, 1), 0)  # blocked actions do not count
            log_probs, values = log_probs[is_step], values[is_step]
            wanted = torch.as_tensor(preferences, dtype=torch.float32)
            scale = self.normalization.return_scale
            target = torch.as_tensor(returns / scale, dtype=torch.float32)
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
        """The current policy."""
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
        return PolicyFile(metadata, network | moment_tensors(self.normalization))


class Batches:
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
