"""Trajectories: TUM text format, interpolation, and association by timestamps."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env._runtime.input_files import read_text, words_of
from ms_slam_env._runtime.output_files import write_text
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.geometry import (
    MAX_COORDINATE_M,
    check_pose,
    pose_from_quaternion,
    quaternion_from_pose,
)

MAX_DIFFERENCE_S = 0.02
"""Largest difference of associated timestamps (the tolerance of the TUM tools)."""

_MAX_TIME_S = 1e20  # allows nanoseconds since 1970

_FIELDS = "timestamp tx ty tz qx qy qz qw"


TRAJECTORY_HEADER = f"# {_FIELDS}"
"""First line of a trajectory file."""

UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
"""Seconds per unit of time."""

_SAID_UNITS = {
    r"\[ns\]|\bnano_?s": "ns",
    r"\[[uµμ]s\]|\bmicro_?s": "us",
    r"\[ms\]|\bmilli_?s": "ms",
    r"\[s\]|\bsec(ond)?s?\b": "s",
}
_CLOCK_S = 9e8, 4.2e9  # plausible range of seconds since 1970


def said_unit(comment: str) -> str | None:
    """The unit of time in a comment such as ``#timestamp [ns]``; None if there is none."""
    said = (u for form, u in _SAID_UNITS.items() if re.search(form, comment.lower()))
    return next(said, None)


def unit_of(times: Float64) -> tuple[str, bool]:
    """The unit of increasing times (N,) found in a file, and whether it is a guess.

    Times since 1970 reveal their unit. For others, a unit is too long if poses or frames would be
    minutes apart: steps of 2000 mean microseconds, steps of two million nanoseconds.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for unit in ("ns", "us", "ms"):
        is_clock = _CLOCK_S[0] <= times[0] * UNITS[unit] < _CLOCK_S[1]
        if is_clock and step * UNITS[unit] < 10:
            return unit, False
    unit = "ns" if step >= 2e6 else "us" if step >= 2e3 else "s"
    return unit, unit != "s"


def in_seconds(times: Float64, where: str | Path, said: str | None = None) -> Float64:
    """Convert increasing times (N,) of a file to seconds; warn if the unit is a guess.

    Args:
        times: times as in the file.
        where: file name for the warning.
        said: unit named in the file, if any.
    """
    if len(times) == 0:
        return times
    unit, is_guess = (said, False) if said else unit_of(times)
    if is_guess:
        say_unit(unit, times, where, "a comment such as [s]")
    return times if unit == "s" else times * UNITS[unit]


def say_unit(unit: str, times: Float64, where: str | Path, otherwise: str) -> None:
    """Warn that the unit of times (N,) is a guess; ``otherwise`` says how to state it."""
    step = float(np.median(np.diff(times)))
    warnings.warn(
        f"{where}: times are taken as {unit}, since they are {step:.6g} apart; {otherwise} says "
        "otherwise",
        InputWarning,
        stacklevel=2,
    )


def trajectory_line(timestamp: float, T_world_camera: Float64) -> str:
    """Format one pose (4, 4) at ``timestamp`` in seconds, without line end."""
    return _lines(np.array([timestamp]), T_world_camera[None])[0]


def _lines(times: Float64, poses: Float64) -> list[str]:
    rows = np.column_stack([times, poses[:, :3, 3], quaternion_from_pose(poses)])
    form = "%.6f" + 7 * " %.9f"
    return [form % tuple(row) for row in rows.tolist()]


def write_trajectory(path: str | Path, timestamps: ArrayLike, poses: ArrayLike) -> None:
    """Write poses T_world_camera (N, 4, 4) at ``timestamps`` (N,) in seconds.

    Raises:
        InputError: lengths that differ.
    """
    times = np.asarray(timestamps, dtype=np.float64)
    matrices = np.asarray(poses, dtype=np.float64)
    if times.ndim != 1 or matrices.shape != (len(times), 4, 4):
        raise InputError(f"{len(times)} timestamps do not fit poses of shape {matrices.shape}")
    lines = [TRAJECTORY_HEADER, *(_lines(times, matrices) if len(times) else ())]
    write_text(Path(path), "\n".join(lines) + "\n")


def _check(row: Float64, where: str) -> None:
    """Refuse an invalid line of eight numbers."""
    if not np.isfinite(row).all():
        raise InputError(f"{where}: a number is not finite")
    if np.abs(row[1:4]).max() > MAX_COORDINATE_M or abs(row[0]) > _MAX_TIME_S:
        raise InputError(
            f"{where}: a position beyond {MAX_COORDINATE_M:g} m or a time beyond {_MAX_TIME_S:g} s"
        )
    if np.abs(row[4:]).max() > 2 or abs(np.linalg.norm(row[4:]) - 1.0) > 1e-2:
        raise InputError(f"{where}: the quaternion {row[4:].tolist()} is not of unit length")


def read_trajectory(path: str | Path) -> tuple[Float64, Float64]:
    """Read a trajectory: timestamps (N,) in seconds and poses T_world_camera (N, 4, 4).

    A comment may name the unit of time, as ``[ns]``, and the order of the columns.

    Raises:
        InputError: no such file, no pose in it, an invalid line, or timestamps that do not
            increase; the message names file and line.
    """
    numbers: list[int] = []
    found: list[list[float]] = []
    said, columns = None, list(range(8))
    for number, line in enumerate(read_text(path, "trajectory").splitlines(), start=1):
        if not line.strip():
            continue
        if line.lstrip().startswith("#"):
            named = re.split(r"[\s,;]+", line.strip("# \t"))
            if sorted(named) == sorted(_FIELDS.split()):
                columns = [named.index(field) for field in _FIELDS.split()]
            said = said or said_unit(line)
            continue
        try:
            row = list(map(float, words_of(line)))
        except ValueError:
            row = []
        if len(row) != 8:
            shown = line.strip()
            raise InputError(
                f"{path}, line {number}: expected the 8 numbers '{_FIELDS}', got {shown!r}"
            )
        numbers.append(number)
        found.append(row)
    if not found:
        raise InputError(f"{path} holds no pose; each line must be '{_FIELDS}'")
    rows = np.array(found)[:, columns]
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(rows[:, 4:], axis=1)
        is_good = (
            np.isfinite(rows).all(axis=1)
            & (np.abs(rows[:, 1:4]).max(axis=1) <= MAX_COORDINATE_M)
            & (np.abs(rows[:, 0]) <= _MAX_TIME_S)
            & (np.abs(rows[:, 4:]).max(axis=1) <= 2)
            & (np.abs(length - 1.0) <= 1e-2)
        )
        goes_on = np.diff(rows[:, 0], prepend=-np.inf) > 0
    if not (is_good & goes_on).all():
        k = int(np.argmin(is_good & goes_on))
        where = f"{path}, line {numbers[k]}"
        _check(rows[k], where)
        raise InputError(f"{where}: timestamp {rows[k, 0]} does not come after {rows[k - 1, 0]}")
    times = in_seconds(rows[:, 0], path, said)
    return times, pose_from_quaternion(rows[:, 1:4], rows[:, 4:])


def associate(times: Float64, others: Float64, max_difference_s: float) -> tuple[Int64, Int64]:
    """Pair timestamps that are mutually nearest; return their indices in order.

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


def say_few_pairs(where: str | Path, pairs: int, count: int) -> None:
    """Warn if fewer than half of the depth images have a colour image of the same time."""
    if 2 * pairs < count:
        text = f"{where}: only {pairs} of {count} depth images have colour of their time"
        warnings.warn(f"{text}; the others are left out", InputWarning, stacklevel=2)


def _nearest(times: Float64, others: Float64) -> Int64:
    """Index (N,) of the nearest of ``others`` (M,) to each of ``times`` (N,)."""
    right = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    left = right - 1
    right = np.minimum(right, len(others) - 1)
    return np.where(times - others[left] <= others[right] - times, left, right).astype(np.int64)


class PoseInterpolation:
    """Interpolates a trajectory, with constant linear and angular velocity between samples.

    Before the first sample and after the last, the motion of the nearest interval continues. At the
    time of a sample the result is that sample, bit for bit.
    """

    def __init__(self, times_s: ArrayLike, poses: ArrayLike) -> None:
        """Take poses (N, 4, 4) at increasing times (N,).

        Raises:
            InputError: no pose, mismatched shapes, times that are not finite or do not increase, or
                a pose that is not a rigid motion.
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
