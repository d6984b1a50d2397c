"""Running moments of observations and returns, by which networks see both."""

from __future__ import annotations

from typing import Any

import numpy as np
from ms_slam_agents.policy import CLIP, EPSILON
from ms_slam_agents.policy_file import PolicyFile, Tensors
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


class PooledMoments(RunningMeanStd):
    """Running moments that are the same for all candidates, whose order means nothing.

    Args:
        inputs: numbers of an observation.
        actions: candidates at its end.
        candidates: numbers of each.
    """

    def __init__(self, inputs: int, actions: int, candidates: int) -> None:
        super().__init__(shape=(inputs,))
        self._tail = slice(inputs - actions * candidates, None)
        self._rows = actions, candidates

    def update(self, arr: NDArray[Any]) -> None:
        """Learn from observations (B, inputs)."""
        self.update_from_moments(*self.pooled(arr), len(arr))

    def pooled(self, observations: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Means and variances (inputs,) of observations (B, inputs)."""
        mean, var = observations.mean(axis=0), observations.var(axis=0)
        rows = observations[:, self._tail].reshape(-1, self._rows[1])
        mean[self._tail] = np.tile(rows.mean(axis=0), self._rows[0])
        var[self._tail] = np.tile(rows.var(axis=0), self._rows[0])
        return mean, var


class Normalization:
    """What VecNormalize knows, for who keeps observations and rewards as they came.

    Args:
        inputs: numbers of an observation.
        actions: that there are.
        candidates: numbers of each action at the end of an observation, all on one scale.
        gamma: discount factor of the returns.
    """

    def __init__(self, inputs: int, actions: int, candidates: int, gamma: float) -> None:
        self.obs_rms: RunningMeanStd = RunningMeanStd(shape=(inputs,))
        if candidates:
            self.obs_rms = PooledMoments(inputs, actions, candidates)
        self.ret_rms = RunningMeanStd(shape=())
        self.gamma = gamma

    def scaled(self, observations: NDArray[Any]) -> NDArray[np.float32]:
        """As a network sees observations (B, inputs)."""
        scaled = (observations - self.obs_rms.mean) / np.sqrt(self.obs_rms.var + EPSILON)
        return np.clip(scaled, -CLIP, CLIP).astype(np.float32)

    def see_rewards(
        self, sums: NDArray[Any], rewards: NDArray[Any], ends: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """Learn from the rewards (B,) of a step.

        Args:
            sums: (B,) discounted, of the rewards before, the latest weighing most.
            rewards: (B,).
            ends: (B,) whether an episode ends with them.

        Returns:
            The sums to go on with.
        """
        sums = sums * self.gamma + rewards
        self.ret_rms.update(sums)
        return np.where(ends, 0.0, sums)

    @property
    def return_scale(self) -> float:
        """What rewards are divided by."""
        return float(np.sqrt(self.ret_rms.var + EPSILON))


def moment_tensors(normalize: VecNormalize | Normalization) -> Tensors:
    """Running moments of observations and returns."""
    return {
        **_moments("observation", normalize.obs_rms),
        **_moments("return", normalize.ret_rms),
    }


def restore_moments(normalize: VecNormalize | Normalization, file: PolicyFile) -> None:
    """Put the running moments where they stood when the file was written."""
    _restore_moments(normalize.obs_rms, file.part("observation"))
    _restore_moments(normalize.ret_rms, file.part("return"))


def _moments(name: str, running: Any) -> Tensors:
    parts = {"mean": running.mean, "var": running.var, "count": running.count}
    return {f"{name}.{part}": np.asarray(v, dtype=np.float64) for part, v in parts.items()}


def _restore_moments(running: Any, saved: Tensors) -> None:
    running.mean, running.var = saved["mean"].copy(), saved["var"].copy()
    running.count = float(saved["count"])
