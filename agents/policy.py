"""Run a trained policy with NumPy alone, without PyTorch or Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from ms_slam_agents.policy_file import CONVOLUTIONS, Metadata, PolicyFile, read_policy
from numpy.typing import NDArray

import ms_slam_env
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError, unknown

Actions = NDArray[np.int64]  # (B,), or (B, numbers) where each action has several

EPSILON = 1e-8  # keeps observations that never change finite
CLIP = 10.0  # standard deviations

_GATES = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")


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
        metadata: from the file: environment, observation, length of training.
        parts: number of choices for each part of an action; one part in most environments.
        num_actions: sum of these, the length of a mask.
    """

    def __init__(self, file: PolicyFile) -> None:
        self.metadata: Metadata = file.metadata
        self.parts = tuple(file.metadata.actions)
        self.num_actions = sum(self.parts)
        network = {name: value.astype(np.float64) for name, value in file.part("policy").items()}
        self._gates = {name: network[f"memory.{name}"] for name in _GATES if file.metadata.memory}
        layers = range(0, 2 * len(file.metadata.hidden), 2)
        names = [*(f"mlp_extractor.policy_net.{i}" for i in layers), "action_net"]
        self._layers = [_layer(network, name) for name in names]
        if file.metadata.quantiles:  # their mean is linear in them
            weight, bias = self._layers.pop()
            columns = weight.reshape(len(weight), -1, file.metadata.quantiles)
            rows = bias.reshape(-1, file.metadata.quantiles)
            self._layers.append((columns.mean(axis=2), rows.mean(axis=1)))
        has_candidates = file.metadata.candidates > 0
        self._encoder = [_layer(network, f"encoder.{i}") for i in (0, 2) if has_candidates]
        self._score = [_layer(network, "score") for _ in range(has_candidates)]
        filters = [f"image.{2 * i}" for i in range(len(CONVOLUTIONS)) if file.metadata.image]
        self._image = [(network[f"{name}.weight"], network[f"{name}.bias"]) for name in filters]
        moments = file.part("observation")
        self._mean, self._std = moments["mean"], np.sqrt(moments["var"] + EPSILON)
        self.reset()

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy file; nothing in it is executed.

        Raises:
            InputError: no such file, or not a policy file of this package.
        """
        return cls(read_policy(path))

    def reset(self) -> None:
        """Begin an episode: clear the memory of ``act``."""
        self._memory = self.empty_memory(1)

    def empty_memory(self, rows: int) -> Float64:
        """Initial memory (B, M) of ``rows`` episodes; M is 0 for a policy without memory."""
        return np.zeros((rows, self.metadata.memory))

    def remember(self, observations: NDArray[Any], memory: Float64) -> Float64:
        """The memory (B, M) after observations (B, k): a gated recurrent unit.

        r = s(W_r x + U_r h), z = s(W_z x + U_z h), n = tanh(W_n x + r U_n h), h' = (1 - z) n + z h,
        biases left out (Cho et al., 2014, in PyTorch's form).
        """
        if not self._gates:
            return memory
        x, _ = self._look(self._scaled(observations))
        of_x = x @ self._gates["weight_ih"].T + self._gates["bias_ih"]
        of_h = memory @ self._gates["weight_hh"].T + self._gates["bias_hh"]
        (r_x, z_x, n_x), (r_h, z_h, n_h) = (np.split(a, 3, axis=1) for a in (of_x, of_h))
        reset, keep = _sigmoid(r_x + r_h), _sigmoid(z_x + z_h)
        return (1 - keep) * np.tanh(n_x + reset * n_h) + keep * memory

    def _scaled(self, observations: NDArray[Any]) -> Float64:
        """Normalise observations as in training."""
        scaled = np.clip((observations - self._mean) / self._std, -CLIP, CLIP)
        return scaled.astype(np.float32).astype(np.float64)

    def _look(self, scaled: Float64) -> tuple[Float64, Float64]:
        """Input of the layers (B, k), and the encoded candidates (B, n, E), if any.

        The input is the state, and the mean and maximum of the encoded candidates, which do not
        depend on their order.
        """
        start = self.metadata.num_state
        if self._image:
            image = scaled[:, start:].reshape(len(scaled), *self.metadata.image)
            for (weight, bias), (_, _, stride) in zip(self._image, CONVOLUTIONS, strict=True):
                image = np.maximum(_convolved(image, weight, stride) + bias[:, None, None], 0)
            seen = np.concatenate([scaled[:, :start], image.reshape(len(scaled), -1)], axis=1)
            return seen, np.zeros((len(scaled), 0, 0))
        if not self._encoder:
            return scaled, np.zeros((len(scaled), 0, 0))
        encoded = scaled[:, start:].reshape(len(scaled), self.num_actions, -1)
        for weight, bias in self._encoder:
            encoded = np.tanh(encoded @ weight + bias)
        pooled = [scaled[:, :start], encoded.mean(axis=1), encoded.max(axis=1)]
        return np.concatenate(pooled, axis=1), encoded

    def probabilities(
        self,
        observations: NDArray[Any],
        masks: NDArray[np.bool_],
        memory: Float64 | None = None,
    ) -> Float64:
        """Probabilities (B, n) of the actions, 0 where ``masks`` (B, n) is false.

        For an action of several parts, the probabilities of the parts are concatenated; each part
        sums to 1. For a quantile network, 1 for the action with the largest expected return.

        Args:
            observations: (B, k) as the environment returns them, not normalised.
            masks: (B, n) true for permitted actions, at least one per row and part.
            memory: (B, M) after these observations, as ``remember`` returns it; None: empty.

        Raises:
            InputError: observations or masks of another environment or variant.
        """
        self._check(observations, masks)
        *hidden, (weight, bias) = self._layers
        memory = self.empty_memory(len(masks)) if memory is None else memory
        seen, encoded = self._look(self._scaled(observations))
        x = np.concatenate([seen, memory], axis=1)
        for hidden_weight, hidden_bias in hidden:
            x = np.tanh(x @ hidden_weight + hidden_bias)
        for score_weight, score_bias in self._score:  # of each candidate, by itself and the whole
            beside = np.broadcast_to(x[:, None], (*encoded.shape[:2], x.shape[1]))
            x = np.tanh(np.concatenate([encoded, beside], axis=2) @ score_weight + score_bias)
        logits = np.where(masks, (x @ weight + bias).reshape(masks.shape), -np.inf)
        if self.metadata.quantiles:
            return np.eye(self.num_actions)[logits.argmax(axis=1)]
        return np.concatenate([_softmax(part) for part in split(logits, self.parts)], axis=1)

    def _check(self, observations: NDArray[Any], masks: NDArray[np.bool_]) -> None:
        for name, given, length in (
            ("observations", observations, self.metadata.inputs),
            ("masks", masks, self.num_actions),
        ):
            if np.ndim(given) != 2 or np.shape(given)[1] != length:
                raise InputError(
                    f"{name} of shape {np.shape(given)}: the policy expects (B, {length}), "
                    f"as {self.metadata.env_id} with observation={self.metadata.observation!r} has"
                )

    def act(
        self,
        observation: NDArray[Any],
        mask: NDArray[np.bool_],
        rng: np.random.Generator | None = None,
    ) -> Any:
        """Choose one action, using the memory since ``reset``.

        Returns an integer, or an array of integers where an action has several parts.

        Args:
            observation: (k,) as the environment returns it.
            mask: (n,) ``info["action_mask"]``.
            rng: generator to sample from the probabilities; None: take the most probable action.

        Raises:
            InputError: an observation or a mask of another shape.
        """
        seen, mask = np.asarray(observation)[None], np.asarray(mask, dtype=bool)
        self._check(seen, mask[None])
        self._memory = self.remember(seen, self._memory)
        probabilities = self.probabilities(seen, mask[None], self._memory)
        if rng is None:
            (action,) = most_probable(probabilities, self.parts)
        else:
            (action,) = sample(probabilities, [rng], self.parts)
        return action if np.ndim(action) else int(action)

    def see(self, observation: NDArray[Any]) -> None:
        """Update the memory with an observation (k,) for which another planner acts."""
        self._memory = self.remember(np.asarray(observation)[None], self._memory)

    def make_env(self, **options: Any) -> gym.Env[Any, Any]:
        """Make a matching environment: ``gym.make`` with the id, observation and steps of training.

        Args:
            options: of ``gym.make``, such as ``scene`` or ``max_episode_steps``; they override
                those of training.

        Raises:
            InputError: the environment is not installed, or it or the policy refuses an option.
        """
        known = self.metadata.env_options | {"observation": self.metadata.observation}
        try:
            env = gym.make(self.metadata.env_id, **{**known, **options})
        except gym.error.Error:
            raise unknown("environment", self.metadata.env_id, ms_slam_env.ENV_IDS) from None
        self.check_fits(env)
        return env

    def check_fits(self, env: Any) -> None:
        """Refuse an environment whose observations or actions differ from the policy's.

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


def _convolved(images: Float64, weight: Float64, stride: int) -> Float64:
    """Convolve images (B, C, H, W) with filters (O, C, K, K), as PyTorch's ``conv2d``."""
    windows = np.lib.stride_tricks.sliding_window_view(images, weight.shape[2:], axis=(2, 3))
    near = windows[:, :, ::stride, ::stride]  # (B, C, rows, columns, K, K)
    return np.moveaxis(np.tensordot(near, weight, axes=((1, 4, 5), (1, 2, 3))), 3, 1)


def _layer(network: dict[str, Float64], name: str) -> tuple[Float64, Float64]:
    """Weight, transposed, and bias of a layer."""
    return network[f"{name}.weight"].T, network[f"{name}.bias"]


def action_parts(space: Any) -> tuple[int, ...]:
    """Number of choices for each part of an action of a discrete space."""
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(n) for n in space.nvec)
    return (int(space.n),)


def sample(
    probabilities: Float64, rngs: Sequence[np.random.Generator], parts: Sequence[int] = ()
) -> Actions:
    """Draw one action per row of ``probabilities`` (B, n), each from its own generator.

    With several ``parts``, actions are (B, parts). A draw takes one number from the generator,
    whatever the probabilities.
    """
    drawn = [
        [rng.choice(len(row), p=row) for rng, row in zip(rngs, part, strict=True)]
        for part in split(probabilities, parts)
    ]
    return joined(drawn)


def most_probable(probabilities: Float64, parts: Sequence[int] = ()) -> Actions:
    """The most probable action of each row of ``probabilities`` (B, n), shaped as in ``sample``."""
    return joined([np.argmax(part, axis=1) for part in split(probabilities, parts)])


def split(values: NDArray[Any], parts: Sequence[int]) -> list[NDArray[Any]]:
    """Split columns by the parts of an action."""
    return np.split(values, np.cumsum(parts)[:-1], axis=1) if len(parts) > 1 else [values]


def joined(numbers: Sequence[Any]) -> Actions:
    """Join the choices (B,) of each part into actions."""
    return np.stack(numbers, axis=1) if len(numbers) > 1 else np.array(numbers[0])


def _sigmoid(values: Float64) -> Float64:
    return np.asarray(0.5 * (1 + np.tanh(0.5 * values)))  # never overflows


def _softmax(logits: Float64) -> Float64:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def _product(parts: Sequence[int]) -> str:
    return " x ".join(map(str, parts))
