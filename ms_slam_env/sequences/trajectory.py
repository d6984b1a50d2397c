"""Trajectories: as text in the TUM format, between their samples, and with others' timestamps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import (
    MAX_COORDINATE_M,
    Float64,
    check_pose,
    pose_from_quaternion,
    quaternion_from_pose,
)
from ms_slam_env.input_files import read_text
from ms_slam_env.output_files import write_text

Int64 = NDArray[np.int64]

MAX_DIFFERENCE_S = 0.02
"""Timestamps further apart do not belong together (the tolerance of the TUM tools)."""

_MAX_TIME_S = 1e20  # nanoseconds since 1970 are taken too, as they stand

_FIELDS = "timestamp tx ty tz qx qy qz qw"


TRAJECTORY_HEADER = f"# {_FIELDS}"
"""First line of a file of poses."""


def trajectory_line(timestamp: float, T_world_camera: Float64) -> str:
    """One pose (4, 4) at ``timestamp`` in seconds, without line end."""
    values = (*T_world_camera[:3, 3], *quaternion_from_pose(T_world_camera))
    return f"{timestamp:.6f} " + " ".join(f"{value:.9f}" for value in values)


def write_trajectory(path: str | Path, timestamps: ArrayLike, poses: ArrayLike) -> None:
    """Write poses T_world_camera (N, 4, 4) at ``timestamps`` (N,) in seconds.

    Raises:
        InputError: lengths that differ.
    """
    times = np.asarray(timestamps, dtype=np.float64)
    matrices = np.asarray(poses, dtype=np.float64)
    if times.ndim != 1 or matrices.shape != (len(times), 4, 4):
        raise InputError(f"{len(times)} timestamps do not fit poses of shape {matrices.shape}")
    lines = [TRAJECTORY_HEADER, *map(trajectory_line, times, matrices)]
    write_text(Path(path), "\n".join(lines) + "\n")


def _parse(line: str, where: str) -> Sequence[float]:
    """Read the eight numbers of a line, or raise one error naming file and line."""
    words = line.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise InputError(f"{where}: expected the 8 numbers '{_FIELDS}', got {line.strip()!r}")
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: a number is not finite")
    if max(map(abs, numbers[1:4])) > MAX_COORDINATE_M or abs(numbers[0]) > _MAX_TIME_S:
        raise InputError(
            f"{where}: a position beyond {MAX_COORDINATE_M:g} m or a time beyond {_MAX_TIME_S:g} s"
        )
    if max(map(abs, numbers[4:])) > 2 or abs(np.linalg.norm(numbers[4:]) - 1.0) > 1e-2:
        raise InputError(f"{where}: the quaternion {numbers[4:]} is not of unit length")
    return numbers


def read_trajectory(path: str | Path) -> tuple[Float64, Float64]:
    """Read a trajectory: timestamps (N,) in seconds and poses T_world_camera (N, 4, 4).

    Raises:
        InputError: no such file, no pose in it, a line that does not parse, or timestamps that
            do not increase; the message names file and line.
    """
    text = read_text(path, "trajectory")
    times: list[float] = []
    poses: list[Float64] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        time, *rest = _parse(line, where)
        if times and time <= times[-1]:
            raise InputError(f"{where}: timestamp {time} does not come after {times[-1]}")
        times.append(time)
        poses.append(pose_from_quaternion(rest[:3], rest[3:]))
    if not times:
        raise InputError(f"{path} holds no pose; each line must be '{_FIELDS}'")
    return np.array(times), np.stack(poses)


def associate(times: Float64, others: Float64, max_difference_s: float) -> tuple[Int64, Int64]:
    """Pairs of indices of timestamps that are each other's nearest, in order.

    Args:
        times: (N,) increasing, seconds.
        others: (M,) increasing, seconds.
        max_difference_s: largest difference within a pair.
    """
    if not max_difference_s >= 0:
        raise InputError(f"max_difference_s = {max_difference_s} must be >= 0")
    nearest = _nearest(times, others)
    mutual = _nearest(others, times)[nearest] == np.arange(len(times))
    close = np.abs(times - others[nearest]) <= max_difference_s
    first = np.flatnonzero(mutual & close)
    return first, nearest[first]


def _nearest(times: Float64, others: Float64) -> Int64:
    """Index (N,) of the one of ``others`` (M,) nearest to each of ``times`` (N,)."""
    right = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    left = right - 1
    right = np.minimum(right, len(others) - 1)
    return np.where(times - others[left] <= others[right] - times, left, right).astype(np.int64)


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
        from scipy.spatial.transform import Rotation

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
        from scipy.spatial.transform import Rotation

        t = np.asarray(times_s, dtype=np.float64)
        before = np.clip(np.searchsorted(self.times_s, t, side="right") - 1, 0, None)
        since = (t - self.times_s[before])[..., None]
        result = self.poses[before].copy()
        turn = Rotation.from_rotvec((since * self._spin[before]).reshape(-1, 3)).as_matrix()
        result[..., :3, :3] = result[..., :3, :3] @ turn.reshape(*t.shape, 3, 3)
        result[..., :3, 3] += since * self._velocity[before]
        return result
