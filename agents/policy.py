"""A trained policy in NumPy alone: running it needs neither PyTorch nor Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from ms_slam_agents.policy_file import Metadata, PolicyFile, read_policy
from numpy.typing import NDArray

import ms_slam_env
from ms_slam_env.errors import InputError, unknown

Actions = NDArray[np.int64]  # (B,), or (B, numbers) where each action has several
Float64 = NDArray[np.float64]

EPSILON = 1e-8  # keeps observations that never change finite
CLIP = 10.0  # standard deviations


class Policy:
    """A trained network with its normalisation: observations in, action probabilities out.

    ::

        policy = Policy.load("agents/policies/room.safetensors")
        env = policy.make_env(scene="table")
        rng = np.random.default_rng(0)
        observation, info = env.reset(seed=0)
        for _ in range(10):
            action = policy.act(observation, info["action_mask"], rng)
            observation, reward, terminated, truncated, info = env.step(action)

    Args:
        file: as ``read_policy`` returns it.

    Attributes:
        metadata: what the file says: environment, observation, how long it was trained.
        parts: choices of each number that an action consists of; one number in most environments.
        num_actions: all of them together, the length of a mask.
    """

    def __init__(self, file: PolicyFile) -> None:
        self.metadata: Metadata = file.metadata
        self.parts = tuple(file.metadata.actions)
        self.num_actions = sum(self.parts)
        network = {name: value.astype(np.float64) for name, value in file.part("policy").items()}
        layers = range(0, 2 * len(file.metadata.hidden), 2)
        names = [*(f"mlp_extractor.policy_net.{i}" for i in layers), "action_net"]
        self._layers = [(network[f"{n}.weight"].T, network[f"{n}.bias"]) for n in names]
        moments = file.part("observation")
        self._mean, self._std = moments["mean"], np.sqrt(moments["var"] + EPSILON)

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy file; nothing in it is executed.

        Raises:
            InputError: there is no such file, or it is not a policy file of this package.
        """
        return cls(read_policy(path))

    def probabilities(self, observations: NDArray[Any], masks: NDArray[np.bool_]) -> Float64:
        """Probabilities (B, n) of the actions, 0 where ``masks`` (B, n) is false.

        Of an action of several numbers, those of each number side by side; each sums to 1.

        Args:
            observations: (B, k) as the environment returns them, not normalised.
            masks: (B, n) true for permitted actions, at least one a row and number.

        Raises:
            InputError: observations of another environment or variant, or such masks.
        """
        for name, given, length in (
            ("observations", observations, self.metadata.inputs),
            ("masks", masks, self.num_actions),
        ):
            if np.ndim(given) != 2 or np.shape(given)[1] != length:
                raise InputError(
                    f"{name} of shape {np.shape(given)}: the policy expects (B, {length}), "
                    f"as {self.metadata.env_id} with observation={self.metadata.observation!r} has"
                )
        scaled = np.clip((observations - self._mean) / self._std, -CLIP, CLIP)
        *hidden, (weight, bias) = self._layers
        x = scaled.astype(np.float32).astype(np.float64)  # as the network saw them in training
        for hidden_weight, hidden_bias in hidden:
            x = np.tanh(x @ hidden_weight + hidden_bias)
        logits = np.where(masks, x @ weight + bias, -np.inf)
        return np.concatenate([_softmax(part) for part in split(logits, self.parts)], axis=1)

    def act(
        self,
        observation: NDArray[Any],
        mask: NDArray[np.bool_],
        rng: np.random.Generator | None = None,
    ) -> Any:
        """One action: an integer, or an array of them where an action has several numbers.

        Args:
            observation: (k,) as the environment returns it.
            mask: (n,) ``info["action_mask"]``.
            rng: to draw from the probabilities; None: take the most probable action.

        Raises:
            InputError: an observation or a mask of another shape.
        """
        mask = np.asarray(mask, dtype=bool)
        probabilities = self.probabilities(np.asarray(observation)[None], mask[None])
        if rng is None:
            (action,) = most_probable(probabilities, self.parts)
        else:
            (action,) = sample(probabilities, [rng], self.parts)
        return action if np.ndim(action) else int(action)

    def make_env(self, **options: Any) -> gym.Env[Any, Any]:
        """The environment that fits: ``gym.make`` with the id, observation and steps of training.

        Args:
            options: of ``gym.make``, as ``scene`` or ``max_episode_steps``; they come before those
                of training.

        Raises:
            InputError: an environment that is not installed, or options that it or the policy
                refuses.
        """
        known = self.metadata.env_options | {"observation": self.metadata.observation}
        try:
            env = gym.make(self.metadata.env_id, **{**known, **options})
        except gym.error.Error:
            raise unknown("environment", self.metadata.env_id, ms_slam_env.ENV_IDS) from None
        self.check_fits(env)
        return env

    def check_fits(self, env: Any) -> None:
        """Refuse an environment with other observations or actions than the policy has.

        Raises:
            InputError: naming both sides.
        """
        parts = action_parts(env.action_space)
        if self.parts != parts:
            raise InputError(
                f"the policy chooses among {_product(self.parts)} actions, "
                f"the environment has {_product(parts)}"
            )
        if env.observation_space.shape != (self.metadata.inputs,):
            raise InputError(
                f"the policy was trained on observation={self.metadata.observation!r}, "
                f"{self.metadata.inputs} numbers; the environment's observations have shape "
                f"{env.observation_space.shape}"
            )


def action_parts(space: Any) -> tuple[int, ...]:
    """Choices of each number that an action of a discrete space consists of."""
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(n) for n in space.nvec)
    return (int(space.n),)


def sample(
    probabilities: Float64, rngs: Sequence[np.random.Generator], parts: Sequence[int] = ()
) -> Actions:
    """Draw one action a row of ``probabilities`` (B, n), each from its own generator.

    With several ``parts``, choices of each number of an action, (B, numbers). A draw takes one
    number of the generator whatever the probabilities are.
    """
    drawn = [
        [rng.choice(len(row), p=row) for rng, row in zip(rngs, part, strict=True)]
        for part in split(probabilities, parts)
    ]
    return joined(drawn)


def most_probable(probabilities: Float64, parts: Sequence[int] = ()) -> Actions:
    """The most probable action of each row of ``probabilities`` (B, n), as ``sample`` has them."""
    return joined([np.argmax(part, axis=1) for part in split(probabilities, parts)])


def split(values: NDArray[Any], parts: Sequence[int]) -> list[NDArray[Any]]:
    """The columns of each number of an action."""
    return np.split(values, np.cumsum(parts)[:-1], axis=1) if len(parts) > 1 else [values]


def joined(numbers: Sequence[Any]) -> Actions:
    """Actions from the choices (B,) of each of their numbers."""
    return np.stack(numbers, axis=1) if len(numbers) > 1 else np.array(numbers[0])


def _softmax(logits: Float64) -> Float64:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def _product(parts: Sequence[int]) -> str:
    return " x ".join(map(str, parts))
