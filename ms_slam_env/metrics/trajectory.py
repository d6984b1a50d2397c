"""Absolute errors of estimated trajectories (ATE), and helpers for all trajectory measures.

Sources: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Qu, Zhang,
Yang, Dong, "USME", Navigation Positioning and Timing 2021, equations (1) and (2). With R_i, p_i the
true pose and R'_i, p'_i the estimate after alignment, the errors at pose i are |p_i - p'_i| and the
angle of R_i^T R'_i; ATE is their root mean square. The variant with p_i - dR_i p'_i is in
`relative`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import as_numbers, invert, so3_exp
from ms_slam_env.geometry.point_clouds import umeyama

P = ParamSpec("P")
T = TypeVar("T")

ERROR_KINDS = ("translation", "rotation")


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of one error per pose or pair of poses, in the unit of the error.

    ``rmse`` is the measure of USME's equations (2) and (5); ``std`` is the population standard
    deviation.
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
    values = as_numbers(trajectory, name)
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        values = values[:, :3, 3]
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (N, 4, 4) poses or (N, 3) positions, got {values.shape}")
    return _filled(values, name)


def check_poses(trajectory: ArrayLike, name: str) -> Float64:
    """Poses (N, 4, 4), checked."""
    values = as_numbers(trajectory, name)
    if values.ndim != 3 or values.shape[1:] != (4, 4):
        raise InputError(f"{name} must be (N, 4, 4) poses, got {values.shape}")
    return _filled(values, name)


def check_times(times: ArrayLike, count: int, name: str = "times") -> Float64:
    """Times (N,) in seconds, finite and increasing, of ``count`` poses, checked."""
    values = as_numbers(times, name)
    if values.shape != (count,) or not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
        raise InputError(f"{name} must be ({count},), finite and increase")
    return values


def check_pair(
    estimate: ArrayLike, truth: ArrayLike, need_poses: bool = True, whose: str = ""
) -> tuple[Float64, Float64]:
    """Checked estimate and truth that correspond by row: poses (N, 4, 4) or positions (N, 3)."""
    check = check_poses if need_poses else check_positions
    own, true = check(estimate, f"estimate{whose}"), check(truth, f"truth{whose}")
    if len(own) != len(true):
        raise InputError(
            f"estimate has {len(own)} poses and truth {len(true)}; they must correspond"
        )
    return own, true


def check_count(value: object, name: str, least: int = 1) -> None:
    """Refuse a value that is not an integer >= ``least``."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name} must be an integer >= {least}, got {value!r}")


def check_positive(value: float, name: str, unit: str = "") -> None:
    """Refuse a value that is not finite and above 0."""
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not (is_number and np.isfinite(value) and value > 0):
        raise InputError(f"{name} must be finite and > 0{unit and ' '}{unit}, got {value!r}")


def check_kind(kind: str) -> None:
    """Refuse an unknown kind of error."""
    if kind not in ERROR_KINDS:
        raise unknown("kind of error", kind, ERROR_KINDS)


def with_arguments_of(
    errors: Callable[P, Float64],
) -> Callable[[Callable[[Float64], T]], Callable[P, T]]:
    """Decorator: let a function of errors (N,) take the arguments of ``errors`` instead."""

    def wrap(summary: Callable[[Float64], T]) -> Callable[P, T]:
        @wraps(summary)
        def of_arguments(*args: P.args, **options: P.kwargs) -> T:
            return summary(errors(*args, **options))

        hints = {**errors.__annotations__, "return": summary.__annotations__["return"]}
        of_arguments.__annotations__ = hints
        of_arguments.__signature__ = signature(errors)  # type: ignore[attr-defined]
        return of_arguments

    return wrap


def _filled(values: Float64, name: str) -> Float64:
    if len(values) == 0:
        raise InputError(f"{name} is empty")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values


ALIGNMENTS = ("se3", "sim3", "yaw", "origin", "none")
"""Rigid motion; rigid motion and scale; translation and yaw; first pose onto first; unchanged."""
FITTED = ("se3", "sim3", "yaw")
"""Alignments found by least squares, from all poses or the first few."""


@dataclass(frozen=True)
class Alignment:
    """Similarity that maps an estimate to the truth: x_truth = scale R x_estimate + t.

    Attributes:
        R: (3, 3).
        t: (3,) metres.
        scale: 1 unless scale was estimated.
        unique: whether the best rotation is unique; it is not if all positions lie on a line or
            coincide.
    """

    R: Float64
    t: Float64
    scale: float
    unique: bool

    def positions(self, positions: Float64) -> Float64:
        """Aligned positions (N, 3)."""
        return self.scale * positions @ self.R.T + self.t

    def poses(self, poses: Float64) -> Float64:
        """Aligned poses (N, 4, 4); rotations stay rotations."""
        aligned = np.array(poses, dtype=np.float64)
        aligned[:, :3, :3] = self.R @ aligned[:, :3, :3]
        aligned[:, :3, 3] = self.positions(aligned[:, :3, 3])
        return aligned


def find_alignment(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", first: int | None = None
) -> Alignment:
    """Least-squares alignment of positions (Umeyama, PAMI 1991).

    ``yaw`` estimates only the translation and the rotation about the world's z axis, which a
    camera with an inertial unit leaves undetermined (Zhang, Scaramuzza, "A tutorial on
    quantitative trajectory evaluation", IROS 2018); ``origin`` aligns the first estimated pose
    with the first true one.

    Args:
        estimate: T_world_camera (N, 4, 4), or positions (N, 3) except for ``origin``.
        truth: likewise, corresponding by row.
        align: ``se3`` (best rigid motion), ``sim3`` (and scale), ``yaw``, ``origin`` or ``none``.
        first: number of poses from the start to align; None for all.

    Raises:
        InputError: wrong shapes, no poses, lengths that differ, NaN, unknown alignment; ``sim3``
            of an estimate that stands still; ``first`` of an alignment without least squares.
    """
    if align not in ALIGNMENTS:
        raise unknown("alignment", align, ALIGNMENTS)
    check_first(align, first)
    own, true = check_pair(estimate, truth, need_poses=align == "origin")
    if align == "none":
        return Alignment(np.eye(3), np.zeros(3), 1.0, unique=True)
    if align == "origin":
        T_truth_estimate = true[0] @ invert(own[0])
        return Alignment(T_truth_estimate[:3, :3], T_truth_estimate[:3, 3], 1.0, unique=True)
    positions, true_positions = own[:first], true[:first]
    if align == "yaw":
        return _yaw_alignment(positions, true_positions)
    R, t, scale = umeyama(positions, true_positions, with_scale=align == "sim3")
    spread = np.linalg.svd(_covariance(positions, true_positions), compute_uv=False)
    return Alignment(R, t, scale, unique=_stands_out(float(spread[1]), float(spread[0])))


def check_first(align: str, first: int | None) -> None:
    """Refuse an invalid ``first`` (see `find_alignment`), or one that ``align`` cannot use."""
    if first is None:
        return
    check_count(first, "first")
    if align not in FITTED:
        raise InputError(f"only {', '.join(FITTED)} can align by the first poses, not {align}")


def _covariance(positions: Float64, true_positions: Float64) -> Float64:
    """Sum (3, 3) of outer products of true and estimated positions, each minus its mean."""
    centred = true_positions - true_positions.mean(axis=0)
    return centred.T @ (positions - positions.mean(axis=0))


def _stands_out(value: float, size: float) -> bool:
    """Whether ``value`` exceeds the rounding error of numbers of this size."""
    return bool(value > 1e-12 * max(size, 1e-12))


def _yaw_alignment(positions: Float64, true_positions: Float64) -> Alignment:
    """Least squares over rotations about z and translations; the angle has a closed form."""
    S = _covariance(positions, true_positions)
    sine, cosine = S[1, 0] - S[0, 1], S[0, 0] + S[1, 1]
    R = so3_exp([0.0, 0.0, np.arctan2(sine, cosine)])
    t = true_positions.mean(axis=0) - R @ positions.mean(axis=0)
    return Alignment(
        R, t, 1.0, unique=_stands_out(float(np.hypot(sine, cosine)), float(np.linalg.norm(S)))
    )


def absolute_errors(
    estimate: ArrayLike,
    truth: ArrayLike,
    align: str = "se3",
    kind: str = "translation",
    first: int | None = None,
) -> Float64:
    """Errors (N,) of the poses after alignment of the positions, USME equation (1).

    Args:
        estimate: T_world_camera (N, 4, 4); positions (N, 3) suffice for ``translation``.
        truth: likewise, corresponding by row.
        align: ``se3`` (best rigid motion), ``sim3`` (and scale), ``yaw``, ``origin`` or ``none``.
        kind: ``translation``, metres, or ``rotation``, radians.
        first: number of poses from the start to align; None for all.

    Raises:
        InputError: as `find_alignment`; an unknown kind; ``rotation`` after an alignment whose
            rotation is not unique, because the positions lie on a line.
    """
    check_kind(kind)
    found = find_alignment(estimate, truth, align, first)
    if kind == "rotation":
        poses, true_poses = check_pair(estimate, truth)
        if not found.unique:
            raise InputError(
                "positions on a line leave the alignment of orientations open; align='none' works"
            )
        relative = np.swapaxes(true_poses[:, :3, :3], 1, 2) @ found.poses(poses)[:, :3, :3]
        return rotation_angles(relative)
    positions, true_positions = check_pair(estimate, truth, need_poses=False)
    return np.linalg.norm(found.positions(positions) - true_positions, axis=1)


@with_arguments_of(absolute_errors)
def ate_statistics(errors: Float64) -> ErrorStatistics:
    """Statistics of the absolute trajectory error (m or rad), from `absolute_errors`' arguments."""
    return statistics_of(errors)


@with_arguments_of(absolute_errors)
def ate_rmse(errors: Float64) -> float:
    """Root mean square of the `absolute_errors` (m or rad), USME equation (2); same arguments."""
    return statistics_of(errors).rmse


def tracked_errors(
    estimate: ArrayLike, truth: ArrayLike, tracked: ArrayLike
) -> dict[str, float | None]:
    """ATE and share of the tracked frames; the plain ATE counts poses held while tracking is lost.

    Args:
        estimate: T_world_camera (N, 4, 4), or positions (N, 3).
        truth: likewise, corresponding by row.
        tracked: (N,) bool, whether the frame was tracked.

    Returns:
        ``tracked_share``, and ``ate_tracked_m`` (RMSE) of the tracked frames after their own SE(3)
        alignment; None for fewer than two frames.
    """
    own, true = check_pair(estimate, truth, need_poses=False)
    ok = np.asarray(tracked, dtype=bool)
    if ok.shape != (len(own),):
        raise InputError(f"{len(own)} poses, but tracked of shape {ok.shape}")
    return {
        "ate_tracked_m": ate_rmse(own[ok], true[ok]) if ok.sum() > 1 else None,
        "tracked_share": float(ok.mean()),
    }
