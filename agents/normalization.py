"""Running moments that normalise observations and returns for the networks."""

from __future__ import annotations

from typing import Any

import numpy as np
from ms_slam_agents.policy import CLIP, EPSILON
from ms_slam_agents.policy_file import PolicyFile, Tensors
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


class PooledMoments(RunningMeanStd):
    """Running moments shared by all candidates, whose order has no meaning.

    Args:
        inputs: length of an observation.
        actions: number of candidates at its end.
        candidates: values per candidate.
    """

    def __init__(self, inputs: int, actions: int, candidates: int) -> None:
        super().__init__(shape=(inputs,))
        self._tail = slice(inputs - actions * candidates, None)
        self._rows = actions, candidates

    def update(self, arr: NDArray[Any]) -> None:
        """Update the moments with observations (B, inputs)."""
        self.update_from_moments(*self.pooled(arr), len(arr))

    def pooled(self, observations: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Means and variances (inputs,) of observations (B, inputs)."""
        mean, var = observations.mean(axis=0), observations.var(axis=0)
        rows = observations[:, self._tail].reshape(-1, self._rows[1])
        mean[self._tail] = np.tile(rows.mean(axis=0), self._rows[0])
        var[self._tail] = np.tile(rows.var(axis=0), self._rows[0])
        return mean, var


class Normalization:
    """The moments of VecNormalize, for trainers that store raw observations and rewards.

    Args:
        inputs: length of an observation.
        actions: number of actions.
        candidates: values per action at the end of an observation, normalised alike for all.
        gamma: discount factor of the returns.
    """

    def __init__(self, inputs: int, actions: int, candidates: int, gamma: float) -> None:
        self.obs_rms: RunningMeanStd = RunningMeanStd(shape=(inputs,))
        if candidates:
            self.obs_rms = PooledMoments(inputs, actions, candidates)
        self.ret_rms = RunningMeanStd(shape=())
        self.gamma = gamma

    def scaled(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """Normalise observations (B, inputs)."""
        scaled = (observations - self.obs_rms.mean) / np.sqrt(self.obs_rms.var + EPSILON)
        return np.clip(scaled, -CLIP, CLIP).astype(np.float32)

    def see_rewards(
        self, sums: NDArray[Any], rewards: NDArray[Any], ends: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """Update the moments with the rewards (B,) of a step.

        Args:
            sums: (B,) discounted, of the rewards before, the latest weighing most.
            rewards: (B,).
            ends: (B,) whether an episode ends with them.

        Returns:
            The updated sums.
        """
        sums = sums * self.gamma + rewards
        self.ret_rms.update(sums)
        return np.where(ends, 0.0, sums)

    @property
    def return_scale(self) -> float:
        """The divisor of rewards."""
        return float(np.sqrt(self.ret_rms.var + EPSILON))


def moment_tensors(normalize: VecNormalize | Normalization) -> Tensors:
    """Running moments of observations and returns."""
    return {
        **_moments("observation", normalize.obs_rms),
        **_moments("return", normalize.ret_rms),
    }


def restore_moments(normalize: VecNormalize | Normalization, file: PolicyFile) -> None:
    """Load the running moments from a policy file."""
    _restore_moments(normalize.obs_rms, file.part("observation"))
    _restore_moments(normalize.ret_rms, file.part("return"))


def _moments(name: str, running: Any) -> Tensors:
    parts = {"mean": running.mean, "var": running.var, "count": running.count}
    return {f"{name}.{part}": np.asarray(v, dtype=np.float64) for part, v in parts.items()}


def _restore_moments(running: Any, saved: Tensors) -> None:
    running.mean, running.var = saved["mean"].copy(), saved["var"].copy()
    running.count = float(saved["count"])
