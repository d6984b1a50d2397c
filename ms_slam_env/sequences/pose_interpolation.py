"""Poses between the samples of a trajectory."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose

Float64 = NDArray[np.float64]


class PoseInterpolation:
    """A trajectory at any time: between two samples position and rotation change at constant rate.

    Before the first sample and after the last the motion of the nearest interval goes on. At the
    time of a sample the result is that sample, bit for bit.
    """

    def __init__(self, times_s: ArrayLike, poses: ArrayLike) -> None:
        """Take poses (N, 4, 4) at increasing times (N,).

        Raises:
            InputError: no pose, shapes that do not fit, times that are not finite or do not
                increase, or a pose that is no rigid motion.
        """
        self.times_s: Float64 = np.asarray(times_s, dtype=np.float64)
        self.poses: Float64 = np.asarray(poses, dtype=np.float64)
        count = len(self.times_s)
        if count == 0 or self.times_s.ndim != 1 or self.poses.shape != (count, 4, 4):
            raise InputError(
                f"times of shape {self.times_s.shape} do not fit poses of shape {self.poses.shape}"
            )
        if not np.isfinite(self.times_s).all() or not (np.diff(self.times_s) > 0).all():
            raise InputError("the times of a trajectory must be finite and increase")
        for index, pose in enumerate(self.poses):
            check_pose(pose, f"pose {index} of the trajectory")
        intervals = np.diff(self.times_s)[:, None]
        R = self.poses[:, :3, :3]
        turns = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec()
        still = np.zeros((1, 3))
        spin = turns / intervals if count > 1 else still
        velocity = np.diff(self.poses[:, :3, 3], axis=0) / intervals if count > 1 else still
        self._spin = np.concatenate([spin, spin[-1:]])[:count]  # (N, 3) rad/s, camera frame
        self._velocity = np.concatenate([velocity, velocity[-1:]])[:count]  # (N, 3) m/s, world

    def __call__(self, times_s: ArrayLike) -> Float64:
        """T_world_camera (..., 4, 4) at times (...) in seconds."""
        t = np.asarray(times_s, dtype=np.float64)
        before = np.clip(np.searchsorted(self.times_s, t, side="right") - 1, 0, None)
        since = (t - self.times_s[before])[..., None]
        result = self.poses[before].copy()
        turn = Rotation.from_rotvec((since * self._spin[before]).reshape(-1, 3)).as_matrix()
        result[..., :3, :3] = result[..., :3, :3] @ turn.reshape(*t.shape, 3, 3)
        result[..., :3, 3] += since * self._velocity[before]
        return result
