"""What evaluation and planners may read of an episode."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.env.state import EpisodeState

Float64 = NDArray[np.float64]


class EpisodeRecord(gymnasium.Env[Any, Any]):
    """Trajectories and measures of the episode so far; N frames, S steps."""

    @abstractmethod
    def _current(self) -> EpisodeState:
        """The episode.

        Raises:
            InputError: the environment was not reset.
        """

    @property
    def trajectory_truth(self) -> Float64:
        """(N, 4, 4) true poses of the episode so far."""
        return np.stack(self._current().truth)

    @property
    def trajectory_estimate(self) -> Float64:
        """(N, 4, 4) poses estimated when they were current."""
        return np.stack(self._current().estimates)

    @property
    def trajectory_kinematics(self) -> Float64:
        """(N, 4, 4) poses by forward kinematics, tied to the truth at the first."""
        return np.stack(self._current().kinematics)

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """(N,) whether tracking held at each frame; one that was processed is part of the map."""
        return np.array(self._current().tracked)

    @property
    def processed(self) -> NDArray[np.bool_]:
        """(N,) whether SLAM has seen each frame; frame management drops the others."""
        return np.array(self._current().processed)

    @property
    def timestamps(self) -> Float64:
        """(N,) simulated seconds since the start of the episode, of each frame."""
        return np.array(self._current().times)

    @property
    def divergences(self) -> Float64:
        """(N, 2) divergence of each frame from the one before; zero for the first."""
        return np.stack(self._current().frame_divergences)

    @property
    def step_divergences(self) -> Float64:
        """(S + 1, 2) ``info["divergence"]`` of the start and of each step."""
        return np.stack(self._current().step_divergences)

    @property
    def pose_errors(self) -> Float64:
        """(N,) distance between true and estimated position at each frame, metres."""
        return np.array(self._current().errors)

    @property
    def tracking_ok(self) -> bool:
        """Whether the last frame was tracked."""
        return self._current().tracking_ok

    @property
    def last_frame(self) -> RGBDFrame:
        """The last live frame."""
        return self._current().last_frame

    @property
    def last_motion(self) -> int:
        """The last action; 0 before the first."""
        return self._current().action
