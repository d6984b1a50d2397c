"""Errors of estimated trajectories: absolute (ATE) and relative (RPE).

Source: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import invert
from ms_slam_env.metrics.alignment import umeyama

Float64 = NDArray[np.float64]

ALIGNMENTS = ("se3", "sim3", "none")
RPE_KINDS = ("translation", "rotation")


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of one error per pose, in the unit of the error."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


def check_positions(trajectory: ArrayLike, name: str) -> Float64:
    """Positions (N, 3) of poses (N, 4, 4) or positions (N, 3), checked."""
    values = np.asarray(trajectory, dtype=np.float64)
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        values = values[:, :3, 3]
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (N, 4, 4) poses or (N, 3) positions, got {values.shape}")
    if len(values) == 0:
        raise InputError(f"{name} is empty")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values


def _poses(trajectory: ArrayLike, name: str) -> Float64:
    """Poses (N, 4, 4), checked."""
    values = np.asarray(trajectory, dtype=np.float64)
    if values.ndim != 3 or values.shape[1:] != (4, 4):
        raise InputError(f"{name} must be (N, 4, 4) poses, got {values.shape}")
    if len(values) == 0:
        raise InputError(f"{name} is empty")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values


def check_lengths(estimate: Float64, truth: Float64) -> None:
    """Refuse trajectories that cannot correspond by row."""
    if len(estimate) != len(truth):
        raise InputError(
            f"estimate has {len(estimate)} poses and truth {len(truth)}; they must correspond"
        )


def absolute_errors(estimate: ArrayLike, truth: ArrayLike, align: str = "se3") -> Float64:
    """Distances (N,) in metres between estimated and true positions after alignment.

    Args:
        estimate: T_world_camera (N, 4, 4), or positions (N, 3).
        truth: likewise, corresponding by row.
        align: ``se3`` (best rigid motion), ``sim3`` (and scale) or ``none``.

    Raises:
        InputError: wrong shapes, no poses, lengths that differ, NaN, unknown alignment.
    """
    if align not in ALIGNMENTS:
        raise unknown("alignment", align, ALIGNMENTS)
    positions, true_positions = (
        check_positions(estimate, "estimate"),
        check_positions(truth, "truth"),
    )
    check_lengths(positions, true_positions)
    if align != "none":
        R, t, scale = umeyama(positions, true_positions, with_scale=align == "sim3")
        positions = scale * positions @ R.T + t
    return np.linalg.norm(positions - true_positions, axis=1)


def ate_statistics(estimate: ArrayLike, truth: ArrayLike, align: str = "se3") -> ErrorStatistics:
    """Statistics of the absolute trajectory error in metres; arguments of `absolute_errors`."""
    return statistics_of(absolute_errors(estimate, truth, align))


def ate_rmse(estimate: ArrayLike, truth: ArrayLike, align: str = "se3") -> float:
    """Root mean square absolute trajectory error in metres; arguments of `absolute_errors`."""
    return ate_statistics(estimate, truth, align).rmse


def relative_errors(
    estimate: ArrayLike, truth: ArrayLike, delta: int = 1, kind: str = "translation"
) -> Float64:
    """Errors (N - delta,) of the motions between poses ``delta`` frames apart.

    With Q the true and P the estimated pose, E_i = (Q_i^-1 Q_i+delta)^-1 (P_i^-1 P_i+delta);
    the error is the length of its translation (metres) or the angle of its rotation (radians).

    Raises:
        InputError: wrong shapes, lengths that differ, NaN, fewer than ``delta`` + 1 poses, a
            ``delta`` that is not a positive integer, unknown kind.
    """
    if kind not in RPE_KINDS:
        raise unknown("kind of relative error", kind, RPE_KINDS)
    poses, true_poses = _poses(estimate, "estimate"), _poses(truth, "truth")
    check_lengths(poses, true_poses)
    if isinstance(delta, bool) or not isinstance(delta, (int, np.integer)) or delta < 1:
        raise InputError(f"delta must be an integer >= 1, got {delta!r}")
    if len(poses) <= delta:
        raise InputError(f"delta = {delta} needs at least {delta + 1} poses, got {len(poses)}")
    motion = invert(poses[:-delta]) @ poses[delta:]
    true_motion = invert(true_poses[:-delta]) @ true_poses[delta:]
    error = invert(true_motion) @ motion
    if kind == "translation":
        return np.linalg.norm(error[:, :3, 3], axis=1)
    return _rotation_angles(error[:, :3, :3])


def rpe_statistics(
    estimate: ArrayLike, truth: ArrayLike, delta: int = 1, kind: str = "translation"
) -> ErrorStatistics:
    """Statistics of the relative pose error (m or rad); arguments of `relative_errors`."""
    return statistics_of(relative_errors(estimate, truth, delta, kind))


def rpe_rmse(
    estimate: ArrayLike, truth: ArrayLike, delta: int = 1, kind: str = "translation"
) -> float:
    """Root mean square relative pose error (m or rad); arguments of `relative_errors`."""
    return rpe_statistics(estimate, truth, delta, kind).rmse


def path_length(trajectory: ArrayLike) -> float:
    """Length in metres of the path through poses (N, 4, 4) or positions (N, 3).

    Raises:
        InputError: wrong shape, no poses, NaN.
    """
    positions = check_positions(trajectory, "trajectory")
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _rotation_angles(R: Float64) -> Float64:
    """Angles (N,) in radians of rotations (N, 3, 3), exact near 0 and near pi."""
    vector = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )  # 2 sin(angle) axis
    return np.arctan2(np.linalg.norm(vector, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)


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
