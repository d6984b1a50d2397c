"""Convert between a Stable-Baselines3 model in training and the tensors of a policy file."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from ms_slam_agents.normalization import moment_tensors, restore_moments
from ms_slam_agents.policy_file import MOMENTS, STEP, PolicyFile, Tensors
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import VecNormalize

Model = PPO | MaskablePPO | DQN

ALGORITHMS: dict[str, type[Model]] = {"maskable_ppo": MaskablePPO, "ppo": PPO, "dqn": DQN}

_OF_DQN = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")
"""The layers of DQN's network, under the names of a policy file, in order."""


def tensors_of(model: Model) -> Tensors:
    """Network, optimiser and running moments of a model on normalised environments.

    Of DQN also the network that gives the targets, once it has learnt.
    """
    parts = {"policy": _network(model)}
    if isinstance(model, DQN) and model._n_updates:
        parts["target"] = model.q_net_target
    names = _names(model)
    networks = {
        f"{part}.{name}": p.detach().cpu().numpy()
        for part, network in parts.items()
        for name, p in zip(names, network.state_dict().values(), strict=True)
    }
    optimizer = optimizer_tensors(names, model.policy.optimizer.state_dict())
    return {**networks, **optimizer, **moment_tensors(_normalize(model))}


def epochs_of(model: Model) -> int:
    """Passes over its experience that a model has learnt from."""
    if isinstance(model, DQN):  # of mini-batches, as the other trainers count
        return math.ceil(model._n_updates * model.batch_size / max(1, model.num_timesteps))
    return int(model._n_updates)


def _network(model: Model) -> torch.nn.Module:
    """The network that a policy file has."""
    return model.q_net if isinstance(model, DQN) else model.policy


def _names(model: Model) -> list[str]:
    """Names of the network's parameters in a policy file, in order."""
    if isinstance(model, DQN):
        return [f"{layer}.{kind}" for layer in _OF_DQN for kind in ("weight", "bias")]
    return list(model.policy.state_dict())


def optimizer_tensors(parameters: list[str], state: dict[str, Any]) -> Tensors:
    """State of Adam, as ``state_dict`` has it, under the names of the network's parameters.

    Empty before the first update. All parameters have taken the same number of steps.
    """
    tensors: Tensors = {}
    for i, of_parameter in state["state"].items():
        tensors[STEP] = np.array(float(of_parameter["step"]))
        for moment in MOMENTS:
            tensors[f"optimizer.{parameters[i]}.{moment}"] = of_parameter[moment].numpy()
    return tensors


def restore(model: Model, file: PolicyFile) -> None:
    """Load a model's training state from a policy file, except its environments."""
    names = _names(model)
    _load(_network(model), file.part("policy"), names)
    if file.can_resume:
        restore_adam(model.policy.optimizer, file.part("optimizer"), names)
    restore_moments(_normalize(model), file)
    model.num_timesteps = file.metadata.timesteps
    if not isinstance(model, DQN):
        model._n_updates = file.metadata.epochs
        return
    _load(model.q_net_target, file.part("target" if file.can_resume else "policy"), names)
    if file.can_resume:
        model._n_updates = int(file.tensors[STEP])


def _load(network: torch.nn.Module, tensors: Tensors, names: list[str]) -> None:
    """Load the parameters ``names``, in the network's order."""
    own = zip(network.state_dict(), names, strict=True)
    network.load_state_dict({name: torch.from_numpy(tensors[saved]) for name, saved in own})


def restore_adam(optimizer: torch.optim.Optimizer, saved: Tensors, parameters: list[str]) -> None:
    """Load the state of Adam; ``parameters`` are the names in its order."""
    state = optimizer.state_dict()
    state["state"] = {
        i: {"step": torch.tensor(float(saved["step"]))}
        | {moment: torch.from_numpy(saved[f"{name}.{moment}"]) for moment in MOMENTS}
        for i, name in enumerate(parameters)
    }
    optimizer.load_state_dict(state)


def _normalize(model: Model) -> VecNormalize:
    normalize = model.get_vec_normalize_env()
    assert normalize is not None
    return normalize


def update_on_partial_rollout(model: Model, batch_size: int) -> bool:
    """Let the network learn from a rollout that was stopped; return whether it was long enough.

    Args:
        model: whose ``learn`` was ended by a callback.
        batch_size: samples of a gradient step; fewer are not worth an update.
    """
    if isinstance(model, DQN):  # learns while it plays
        return True
    buffer = model.rollout_buffer
    steps = buffer.pos
    if buffer.full or steps * buffer.n_envs < batch_size:
        return False
    for name, value in vars(buffer).items():
        if isinstance(value, np.ndarray):
            setattr(buffer, name, value[:steps])
    buffer.buffer_size, buffer.full = steps, True
    assert model._last_obs is not None
    assert model._last_episode_starts is not None
    with torch.no_grad():
        values = model.policy.predict_values(torch.as_tensor(model._last_obs))
    buffer.compute_returns_and_advantage(values, model._last_episode_starts)
    model.batch_size = whole_batches(steps * buffer.n_envs, batch_size)
    model.train()
    return True


def whole_batches(samples: int, batch_size: int) -> int:
    """The smallest size from ``batch_size`` on that leaves no batch of a single sample.

    The advantages of one sample have no spread, by which sb3-contrib divides.
    """
    batch_size = min(batch_size, samples)
    while samples % batch_size == 1:
        batch_size += 1
    return batch_size
