"""A straight motion of the camera: line, constant axis of rotation, trapezoid speed."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import so3_log

RAMP = 0.2
"""Share of the duration spent speeding up, and again slowing down."""

PEAK_SPEED = 1 / (1 - RAMP)
"""Greatest speed of a motion in units of its mean speed."""

_STILL_M = 1e-9
_STILL_RAD = 1e-9


def progress(share_of_time: Float64) -> Float64:
    """Share (...,) of the path made after a share (...,) of the duration, both in [0, 1].

    Speed rises linearly during the first ``RAMP`` of the time and falls during the last.
    """
    t = np.clip(share_of_time, 0.0, 1.0)
    acceleration = PEAK_SPEED / RAMP
    cruise = PEAK_SPEED * (t - 0.5 * RAMP)
    rising, falling = 0.5 * acceleration * t**2, 1 - 0.5 * acceleration * (1 - t) ** 2
    return np.where(t < RAMP, rising, np.where(t > 1 - RAMP, falling, cruise))


class CartesianPath:
    """A Cartesian path of the camera from one pose to another.

    The position moves on a straight line while the orientation turns about one axis, both with
    the speed profile of :func:`progress`.

    Attributes:
        duration_s: seconds that the slower of translation and rotation takes; 0 without motion.
    """

    def __init__(
        self,
        T_start: Float64,
        T_end: Float64,
        speed_m_s: float,
        speed_rad_s: float,
        least_duration_s: float = 0.0,
    ) -> None:
        """Plan the path.

        Args:
            T_start: (4, 4) first pose.
            T_end: (4, 4) last pose.
            speed_m_s: greatest speed of the position.
            speed_rad_s: greatest rate of turn.
            least_duration_s: least duration of the motion, unless it is none.
        """
        self._start = np.array(T_start, dtype=np.float64)
        self._step = T_end[:3, 3] - self._start[:3, 3]
        self._turn = so3_log(self._start[:3, :3].T @ T_end[:3, :3])
        distance, angle = float(np.linalg.norm(self._step)), float(np.linalg.norm(self._turn))
        moves = distance > _STILL_M or angle > _STILL_RAD
        fastest = PEAK_SPEED * max(distance / speed_m_s, angle / speed_rad_s)
        self.duration_s = max(fastest, least_duration_s) if moves else 0.0

    def at_share(self, share_of_path: Float64) -> Float64:
        """Poses (k, 4, 4) after shares (k,) of the path."""
        share = np.asarray(share_of_path, dtype=np.float64)[:, None]
        poses = np.tile(np.eye(4), (len(share), 1, 1))
        turned = Rotation.from_rotvec(share * self._turn).as_matrix()
        poses[:, :3, :3] = self._start[:3, :3] @ turned
        poses[:, :3, 3] = self._start[:3, 3] + share * self._step
        return poses

    def at(self, times_s: Float64) -> Float64:
        """Poses (k, 4, 4) at times (k,) since the start; at rest before it and after the end."""
        times = np.asarray(times_s, dtype=np.float64)
        if self.duration_s == 0:
            return self.at_share(np.zeros(len(times)))
        return self.at_share(progress(times / self.duration_s))
