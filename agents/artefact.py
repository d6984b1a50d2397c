"""A trained policy as one file: Stable-Baselines3's archive with what is needed to run it again.

Beside the members that Stable-Baselines3 writes, the archive has ``ms_slam_env.json``: the
observation variant, the running moments that normalised observations and returns, and how long
training has gone. Stable-Baselines3's own part is a pickle: load only files that you trust.
"""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.running_mean_std import RunningMeanStd

from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError, unknown

ALGORITHMS: dict[str, type[PPO] | type[MaskablePPO]] = {"maskable_ppo": MaskablePPO, "ppo": PPO}

_MEMBER = "ms_slam_env.json"
_EPSILON = 1e-8  # keeps observations that never change finite
_CLIP = 10.0  # standard deviations


@dataclass
class Moments:
    """Running mean and variance of a stream of arrays.

    Attributes:
        mean: of each component, nested lists of the stream's shape.
        var: variance of each component.
        count: how much the stream weighs against what comes.
    """

    mean: Any
    var: Any
    count: float

    @classmethod
    def of(cls, running: RunningMeanStd) -> Moments:
        """Copy Stable-Baselines3's moments."""
        return cls(running.mean.tolist(), running.var.tolist(), float(running.count))

    def restore(self, running: RunningMeanStd) -> None:
        """Write the moments back, bit-exactly."""
        running.mean = np.array(self.mean, dtype=np.float64)
        running.var = np.array(self.var, dtype=np.float64)
        running.count = self.count


@dataclass
class Metadata:
    """What the archive says beside Stable-Baselines3's own part.

    Attributes:
        algorithm: one of ``ALGORITHMS``.
        env_id: id of the environment it was trained in.
        observation: observation variant that the policy expects.
        observation_moments: normalise observations.
        return_moments: normalise rewards, needed to train on.
        timesteps: environment steps trained.
        minutes: wall-clock time trained.
        options: the training script's options, for the record.
    """

    algorithm: str
    env_id: str
    observation: str
    observation_moments: Moments
    return_moments: Moments
    timesteps: int = 0
    minutes: float = 0.0
    options: dict[str, Any] = field(default_factory=dict)


def save(path: Path, model: PPO | MaskablePPO, metadata: Metadata) -> None:
    """Write the archive; an interrupt leaves the old file or the new one, never half of one."""
    partial = path.with_name(path.name + ".partial.zip")
    model.save(partial)
    with zipfile.ZipFile(partial, "a") as archive:
        archive.writestr(_MEMBER, json.dumps(asdict(metadata)))
    os.replace(partial, path)


def load_metadata(path: str | Path) -> Metadata:
    """Read what a policy file says about itself.

    Raises:
        InputError: there is no such file, or it is not a policy file of this package.
    """
    if not Path(path).is_file():
        raise InputError(f"no policy file {str(path)!r}")
    try:
        with zipfile.ZipFile(path) as archive:
            metadata = from_dict(Metadata, json.loads(archive.read(_MEMBER)))
    except (zipfile.BadZipFile, KeyError) as error:
        raise InputError(f"{str(path)!r} is not a policy saved by ms_slam_agents") from error
    if metadata.algorithm not in ALGORITHMS:
        raise unknown("algorithm of a policy file", metadata.algorithm, ALGORITHMS)
    return metadata


def action_parts(space: Any) -> tuple[int, ...]:
    """Choices of each number that an action of a discrete space consists of."""
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(n) for n in space.nvec)
    return (int(space.n),)


class Policy:
    """A trained network with its normalisation: observations in, action probabilities out.

    Args:
        model: Stable-Baselines3's model.
        moments: normalise observations.

    Attributes:
        parts: choices of each number that an action consists of; one number in most environments.
        num_actions: all of them together, the length of a mask.
    """

    def __init__(self, model: PPO | MaskablePPO, moments: Moments) -> None:
        self._network = model.policy
        self.parts = action_parts(model.action_space)
        self.num_actions = sum(self.parts)
        self._mean = np.asarray(moments.mean)
        self._std = np.sqrt(np.asarray(moments.var) + _EPSILON)

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy file.

        Raises:
            InputError: there is no such file, or it is not a policy file of this package.
        """
        metadata = load_metadata(path)
        model = ALGORITHMS[metadata.algorithm].load(path, device="cpu")
        return cls(model, metadata.observation_moments)

    def probabilities(self, observations: NDArray[Any], masks: NDArray[np.bool_]) -> NDArray[Any]:
        """Probabilities (B, n) of the actions, 0 where ``masks`` (B, n) is false.

        Of an action of several numbers, those of each number side by side; each sums to 1.

        Args:
            observations: (B, k) as the environment returns them, not normalised.
            masks: (B, n) true for permitted actions, at least one a row and number.
        """
        scaled = np.clip((observations - self._mean) / self._std, -_CLIP, _CLIP)
        self._network.set_training_mode(False)
        with torch.no_grad():
            tensor = torch.as_tensor(scaled.astype(np.float32))
            logits = _logits(self._network.get_distribution(tensor))
        logits = np.where(masks, logits, -np.inf)
        borders = np.cumsum(self.parts)[:-1]
        return np.concatenate([_softmax(x) for x in np.split(logits, borders, axis=1)], axis=1)


def _logits(distribution: Any) -> NDArray[Any]:
    """Logits (B, n) of one categorical distribution, or of several side by side."""
    # Stable-Baselines3 and sb3-contrib name them differently.
    found = getattr(distribution, "distributions", None) or distribution.distribution
    several = found if isinstance(found, list) else [found]
    return np.concatenate([one.logits.double().numpy() for one in several], axis=1)


def _softmax(logits: NDArray[Any]) -> NDArray[Any]:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)
