"""What every measure of trajectories needs: checked poses, statistics, lengths, angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError, unknown

Float64 = NDArray[np.float64]

ERROR_KINDS = ("translation", "rotation")


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of one error per pose or pair of poses, in the unit of the error.

    ``rmse`` over the poses is what USME's equations (2) and (5) define; ``std`` is that of the
    errors themselves, not of a sample of them.
    """

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


def statistics_of(errors: Float64) -> ErrorStatistics:
    """Statistics of errors (N,), N >= 1."""
    return ErrorStatistics(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        std=float(errors.std()),
        min=float(errors.min()),
        max=float(errors.max()),
    )


def path_length(trajectory: ArrayLike) -> float:
    """Length in metres of the path through poses (N, 4, 4) or positions (N, 3).

    Raises:
        InputError: wrong shape, no poses, NaN.
    """
    return float(path_distances(check_positions(trajectory, "trajectory"))[-1])


def path_distances(positions: Float64) -> Float64:
    """Metres (N,) travelled from the first of positions (N, 3) to each."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def rotation_angles(R: Float64) -> Float64:
    """Angles (N,) in radians of rotations (N, 3, 3), exact near 0 and near pi."""
    vector = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )  # 2 sin(angle) axis
    return np.arctan2(np.linalg.norm(vector, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)


def check_positions(trajectory: ArrayLike, name: str) -> Float64:
    """Positions (N, 3) of poses (N, 4, 4) or positions (N, 3), checked."""
    values = _numbers(trajectory, name)
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        values = values[:, :3, 3]
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (N, 4, 4) poses or (N, 3) positions, got {values.shape}")
    return _filled(values, name)


def check_poses(trajectory: ArrayLike, name: str) -> Float64:
    """Poses (N, 4, 4), checked."""
    values = _numbers(trajectory, name)
    if values.ndim != 3 or values.shape[1:] != (4, 4):
        raise InputError(f"{name} must be (N, 4, 4) poses, got {values.shape}")
    return _filled(values, name)


def check_times(times: ArrayLike, count: int, name: str = "times") -> Float64:
    """Times (N,) in seconds, finite and increasing, of ``count`` poses, checked."""
    values = _numbers(times, name)
    if values.shape != (count,) or not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
        raise InputError(f"{name} must be ({count},), finite and increase")
    return values


def check_lengths(estimate: Float64, truth: Float64) -> None:
    """Refuse trajectories that cannot correspond by row."""
    if len(estimate) != len(truth):
        raise InputError(
            f"estimate has {len(estimate)} poses and truth {len(truth)}; they must correspond"
        )


def check_kind(kind: str) -> None:
    """Refuse what is no kind of error."""
    if kind not in ERROR_KINDS:
        raise unknown("kind of error", kind, ERROR_KINDS)


def _numbers(values: ArrayLike, name: str) -> Float64:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} is not an array of numbers") from None


def _filled(values: Float64, name: str) -> Float64:
    if len(values) == 0:
        raise InputError(f"{name} is empty")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values
