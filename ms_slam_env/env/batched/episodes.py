"""The episodes of B environments as arrays; see ``env.episode`` for that of one."""

from __future__ import annotations

from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Bool, Float64, Int64
from ms_slam_env.geometry import invert
from ms_slam_env.robot.embodiment import FRAME_PERIOD_S
from ms_slam_env.slam.surfel.tracked_batch import TrackedBatch


class Episodes:
    """Poses and running measures of B episodes with one frame a step.

    Attributes:
        T_world_camera: (B, 4, 4) true poses.
        T_world_camera_estimate: (B, 4, 4).
        noise_seed: (B,).
        steps: (B,) steps made; the number of the last frame.
        time_s: (B,) of simulation.
        action: (B,) the last; 0 before the first.
        steps_lost: (B,) consecutive steps for which tracking has been lost.
        pose_error: (B,) metres.
        divergence: (B, 2) of the last step, nats.
    """

    def __init__(self, batch: int) -> None:
        def zeros(dtype: Any = np.int64) -> Any:
            return np.zeros(batch, dtype=dtype)

        self.T_world_camera: Float64 = np.tile(np.eye(4), (batch, 1, 1))
        self.T_world_camera_estimate = self.T_world_camera.copy()
        self._T_start_world = self.T_world_camera.copy()
        self.noise_seed: Int64 = zeros()
        self.steps: Int64 = zeros()
        self.action: Int64 = zeros()
        self.steps_lost: Int64 = zeros()
        self.time_s: Float64 = zeros(np.float64)
        self.pose_error: Float64 = zeros(np.float64)
        self._squared_error_sum: Float64 = zeros(np.float64)
        self.tracking_ok: Bool = zeros(bool)
        self.inlier_fraction: Float64 = zeros(np.float64)
        self.divergence: Float64 = np.zeros((batch, 2))
        self._covariance: Float64 = np.zeros((batch, 6, 6))

    def put(self, env: int, T_world_camera: Float64, noise_seed: int) -> None:
        """Let an episode begin at a pose (4, 4), where its first frame is to be taken."""
        self.T_world_camera[env], self.noise_seed[env] = T_world_camera, noise_seed
        for counter in (self.steps, self.action, self.steps_lost):
            counter[env] = 0
        for sums in (self.time_s, self._squared_error_sum):
            sums[env] = 0.0

    def move(self, where: Bool, actions: Int64, motions: Float64) -> None:
        """Make the motions (B, 4, 4) of the episodes ``where`` (B,)."""
        moved = self.T_world_camera @ motions
        self.T_world_camera = np.where(where[:, None, None], moved, self.T_world_camera)
        self.steps += where
        self.action = np.where(where, actions, self.action)
        self.time_s += np.where(where, FRAME_PERIOD_S, 0.0)

    def begin(self, where: Bool) -> None:
        """Record the first frames of the episodes ``where`` (B,), at the true poses."""
        there = where[:, None, None]
        pose = np.where(there, self.T_world_camera, self.T_world_camera_estimate)
        self.T_world_camera_estimate = pose
        self._T_start_world = np.where(there, invert(pose), self._T_start_world)
        self._covariance = np.where(there, _UNKNOWN, self._covariance)
        self.inlier_fraction = np.where(where, 1.0, self.inlier_fraction)
        self.divergence = np.where(where[:, None], 0.0, self.divergence)
        self.pose_error = np.where(where, 0.0, self.pose_error)
        self.tracking_ok = self.tracking_ok | where

    def record(self, where: Bool, found: TrackedBatch, divergence: Float64) -> None:
        """Record the frames of the episodes ``where`` (B,) that moved, and their divergences."""
        there = where[:, None, None]
        self.T_world_camera_estimate = np.where(
            there, found.T_world_camera, self.T_world_camera_estimate
        )
        off = self.T_world_camera_estimate[:, :3, 3] - self.T_world_camera[:, :3, 3]
        self.pose_error = np.where(where, np.linalg.norm(off, axis=1), self.pose_error)
        self._squared_error_sum += np.where(where, self.pose_error**2, 0.0)
        self.tracking_ok = np.where(where, found.tracking_ok, self.tracking_ok)
        self.inlier_fraction = np.where(where, found.inlier_fraction, self.inlier_fraction)
        known = np.isfinite(found.covariance[:, :1, :1])
        covariance = np.where(known, found.covariance, _UNKNOWN)
        self._covariance = np.where(there, covariance, self._covariance)
        self.divergence = np.where(where[:, None], divergence, self.divergence)
        lost = np.where(self.tracking_ok, 0, self.steps_lost + 1)
        self.steps_lost = np.where(where, lost, self.steps_lost)

    @property
    def T_start_camera(self) -> Float64:
        """(B, 4, 4) the last estimated poses, relative to the starts."""
        return self._T_start_world @ self.T_world_camera_estimate

    @property
    def ate(self) -> Float64:
        """(B,) RMSE of the positions over the episodes so far, metres, no alignment."""
        return np.asarray(np.sqrt(self._squared_error_sum / (self.steps + 1)))

    def info(self) -> dict[str, Any]:
        """The episodes' entries of ``info``; the arrays are copies."""
        batch = len(self.steps)
        shown = {
            "T_world_camera": self.T_world_camera,
            "T_world_camera_estimate": self.T_world_camera_estimate,
            "pose_covariance": self._covariance,
            "pose_error": self.pose_error,
            "ate": self.ate,
            "divergence": self.divergence,
            "tracking_ok": self.tracking_ok,
            "submap": np.zeros(batch, dtype=np.int64),
            "time": self.time_s,
            "energy": np.zeros(batch),
        }
        return {name: array.copy() for name, array in shown.items()}


_UNKNOWN = np.where(np.eye(6, dtype=bool), np.inf, 0.0)
