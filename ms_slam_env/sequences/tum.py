"""Trajectories as text in the TUM format: ``timestamp tx ty tz qx qy qz qw``, camera to world."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import pose_from_quaternion, quaternion_from_pose

Float64 = NDArray[np.float64]

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
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


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
    if abs(np.linalg.norm(numbers[4:]) - 1.0) > 1e-2:
        raise InputError(f"{where}: the quaternion {numbers[4:]} is not of unit length")
    return numbers


def read_trajectory(path: str | Path) -> tuple[Float64, Float64]:
    """Read a trajectory: timestamps (N,) in seconds and poses T_world_camera (N, 4, 4).

    Raises:
        InputError: no such file, no pose in it, a line that does not parse, or timestamps that
            do not increase; the message names file and line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read trajectory {path}: {error}") from None
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
