"""Relative errors of estimated trajectories (RPE): of motions between pairs of poses, and by piece.

Sources: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Qu, Zhang,
Yang, Dong, "USME", Navigation Positioning and Timing 2021, equations (3) to (5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import invert
from ms_slam_env.metrics.trajectory import (
    ErrorStatistics,
    check_count,
    check_kind,
    check_pair,
    check_poses,
    check_positive,
    check_times,
    find_alignment,
    path_distances,
    rotation_angles,
    statistics_of,
    with_arguments_of,
)

DELTA_UNITS = ("frames", "m", "s")
PAIRINGS = ("all", "consecutive")
_ROUNDING = 1e-9
TOLERANCE = 0.1  # of a delta in metres or seconds, as a share of it


def pose_pairs(
    truth: ArrayLike,
    delta: float = 1,
    unit: str = "frames",
    times: ArrayLike | None = None,
    pairs: str = "all",
    tolerance: float = TOLERANCE,
) -> Int64:
    """Pairs (K, 2) of poses that are ``delta`` apart, USME equation (3).

    Args:
        truth: T_world_camera (N, 4, 4); metres are those of the true path.
        delta: how far apart.
        unit: of ``delta``: ``frames``, ``m`` along the true path, or ``s``.
        times: (N,) seconds, increasing; needed for ``s`` only.
        pairs: ``all``: every pose that has one is paired with the later pose nearest to ``delta``
            away, if the distance is right to ``tolerance`` times ``delta``. ``consecutive``: each
            pair begins where the one before ends, at the first pose at least ``delta`` away.
        tolerance: of ``all`` in metres or seconds. Frames are counted exactly.

    Raises:
        InputError: bad poses, times or options, or no pair at all.
    """
    poses = check_poses(truth, "truth")
    if unit not in DELTA_UNITS:
        raise unknown("unit of delta", unit, DELTA_UNITS)
    if pairs not in PAIRINGS:
        raise unknown("choice of pairs", pairs, PAIRINGS)
    if not (np.isfinite(tolerance) and tolerance >= 0):
        raise InputError(f"tolerance must be finite and >= 0, got {tolerance}")
    if unit == "frames":
        check_count(delta, "delta")
        if len(poses) <= delta:
            raise InputError(f"delta = {delta} needs at least {delta + 1} poses, got {len(poses)}")
        along, reach = np.arange(len(poses), dtype=np.float64), 0.0
    else:
        check_positive(delta, "delta", unit)
        along, reach = _distances(poses, unit, times), tolerance * delta
    found = _all(along, delta, reach) if pairs == "all" else _consecutive(along, delta)
    if len(found) == 0:
        raise InputError(
            f"no two poses are {delta:g} {unit} apart: the trajectory spans {along[-1]:.6g} {unit}"
        )
    return found


def relative_errors(
    estimate: ArrayLike,
    truth: ArrayLike,
    delta: float = 1,
    kind: str = "translation",
    unit: str = "frames",
    times: ArrayLike | None = None,
    pairs: str = "all",
    tolerance: float = TOLERANCE,
) -> Float64:
    """Errors (K,) of the motions between poses ``delta`` apart, USME equation (4).

    With Q the true and P the estimated poses and (i, j) a pair,
    E_ij = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j); the error is the length of its translation, metres, or the
    angle of its rotation, radians. No alignment enters; an estimate without scale must be scaled
    first.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
        delta: as all but the kind, see `pose_pairs`.
        kind: ``translation`` or ``rotation``.

    Raises:
        InputError: wrong shapes, lengths that differ, NaN, unknown kind, or as `pose_pairs`.
    """
    check_kind(kind)
    poses, true_poses = check_pair(estimate, truth)
    first, second = pose_pairs(true_poses, delta, unit, times, pairs, tolerance).T
    return motion_errors(poses, true_poses, first, second, kind)


def motion_errors(
    poses: Float64, true_poses: Float64, first: Int64, second: Int64, kind: str
) -> Float64:
    """Errors (K,), m or rad, of the motions from poses ``first`` (K,) to ``second`` (K,)."""
    motion = invert(poses[first]) @ poses[second]
    true_motion = invert(true_poses[first]) @ true_poses[second]
    error = invert(true_motion) @ motion
    if kind == "translation":
        return np.linalg.norm(error[:, :3, 3], axis=1)
    return rotation_angles(error[:, :3, :3])


@with_arguments_of(relative_errors)
def rpe_statistics(errors: Float64) -> ErrorStatistics:
    """Statistics of the relative pose error (m or rad); arguments of `relative_errors`."""
    return statistics_of(errors)


@with_arguments_of(relative_errors)
def rpe_rmse(errors: Float64) -> float:
    """Root mean square of the `relative_errors` (m or rad), USME (5); takes their arguments."""
    return statistics_of(errors).rmse


def _distances(poses: Float64, unit: str, times: ArrayLike | None) -> Float64:
    """Metres or seconds (N,) from the first pose to each."""
    if unit == "m":
        return path_distances(poses[:, :3, 3])
    if times is None:
        raise InputError("a delta in seconds needs the times of the poses")
    seconds = check_times(times, len(poses))
    return seconds - seconds[0]


def _all(along: Float64, delta: float, reach: float) -> Int64:
    first = np.arange(len(along) - 1)
    goal = along[first] + delta
    # The nearest later pose is one of the two that enclose the goal.
    after = np.clip(np.searchsorted(along, goal), first + 1, len(along) - 1)
    before = np.maximum(after - 1, first + 1)
    nearer = np.abs(along[before] - goal) <= np.abs(along[after] - goal)
    second = np.where(nearer, before, after)
    close = np.abs(along[second] - along[first] - delta) <= reach
    return np.stack([first[close], second[close]], axis=1)


def _consecutive(along: Float64, delta: float) -> Int64:
    found = []
    first = 0
    while True:
        # Times of 0.1 s add up to a hair more or less than 1 s.
        goal = along[first] + max(delta - _ROUNDING, 0.5 * delta)
        second = max(first + 1, int(np.searchsorted(along, goal)))
        if second >= len(along):
            break
        found.append((first, second))
        first = second
    return np.array(found, dtype=np.int64).reshape(-1, 2)


LENGTH_SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)


@dataclass(frozen=True)
class Drift:
    """Relative errors over one length of path, as shares of it.

    Attributes:
        length_m: of the true path.
        segments: how many sub-trajectories of this length there are.
        translation: metres of error a metre of ``length_m``, without unit; times 100 in per cent.
        rotation_rad_m: radians of error a metre.
    """

    length_m: float
    segments: int
    translation: ErrorStatistics
    rotation_rad_m: ErrorStatistics


def equal_pieces(count: int, pieces: int) -> Int64:
    """Bounds (K, 2) of ``pieces`` pieces of ``count`` poses: first, and one after the last.

    Lengths differ by one pose at most.

    Raises:
        InputError: fewer than one piece, or more pieces than poses.
    """
    check_count(pieces, "segments")
    if pieces > count:
        raise InputError(f"{count} poses cannot be cut into {pieces} segments")
    edges = np.arange(pieces + 1) * count // pieces
    return np.stack([edges[:-1], edges[1:]], axis=1)


def drifts(
    estimate: ArrayLike, truth: ArrayLike, lengths_m: Sequence[float] | None = None, every: int = 1
) -> list[Drift]:
    """Relative errors over sub-trajectories of given lengths, by length.

    Source: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark
    suite", CVPR 2012, whose lengths are 100 to 800 m and whose sub-trajectories begin at every 10th
    frame. One ends at the first pose farther along the true path than its length; errors of the
    motion, as in `relative_errors`, are divided by the length.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
        lengths_m: metres; None for a tenth to a half of the true path (Zhang and Scaramuzza, "A
            tutorial on quantitative trajectory evaluation", IROS 2018).
        every: a sub-trajectory begins at every such frame.

    Returns:
        One for each length that the path has room for; none if the truth stands still and no
        lengths are given.

    Raises:
        InputError: wrong shapes, lengths that differ, NaN, a length or step that is not positive.
    """
    poses, true_poses = check_pair(estimate, truth)
    check_count(every, "every")
    along = path_distances(true_poses[:, :3, 3])
    if lengths_m is None:
        lengths_m = [share * float(along[-1]) for share in LENGTH_SHARES] if along[-1] > 0 else []
    found = []
    for length in lengths_m:
        check_positive(length, "the length of a segment", "m")
        first = np.arange(0, len(poses), every)
        second = np.searchsorted(along, along[first] + length, "right")
        first, second = first[second < len(poses)], second[second < len(poses)]
        if len(first) == 0:
            continue
        translation, rotation = (
            statistics_of(motion_errors(poses, true_poses, first, second, kind) / length)
            for kind in ("translation", "rotation")
        )
        found.append(Drift(float(length), len(first), translation, rotation))
    return found


def printed_errors(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", kind: str = "translation"
) -> Float64:
    """Errors (N,), m or rad, of USME equation (1) to the letter; arguments of `absolute_errors`.

    The typeset formulas are missing from the text that we have; its words (the rotation dR_i
    between estimated and true state, N states, pairs d_k = {x_s, x_e} with e > s) are those of
    Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation for
    visual(-inertial) odometry", IROS 2018, whose formulas these are:

        dR_i = R_i R'_i^T,   dp_i = p_i - dR_i p'_i                                     (1)
        ATE_rot = sqrt(1/N sum |angle(dR_i)|^2),   ATE_pos = sqrt(1/N sum |dp_i|^2)     (2)
        RE = {the same of x_e, after x'_s was laid onto x_s}                            (4), (5)

    with R, p the truth and R', p' the estimate after alignment. dp_i is no distance between
    positions: an error of orientation moves it by as much as the camera is away from the world's
    origin, so that the same trajectories in another world have another error. `ate_rmse` has
    |p_i - p'_i| there, as all tools do. The angles are the same.
    """
    check_kind(kind)
    poses, true = check_pair(estimate, truth)
    return _state_errors(find_alignment(poses, true, align).poses(poses), true, kind)


@with_arguments_of(printed_errors)
def printed_ate(errors: Float64) -> ErrorStatistics:
    """Statistics of `printed_errors`; ``rmse`` is USME equation (2)."""
    return statistics_of(errors)


def printed_relative_errors(
    estimate: ArrayLike, truth: ArrayLike, kind: str = "translation", **which: Any
) -> Float64:
    """The set (K,) of USME equation (5), m or rad, of the pairs ``which`` of `pose_pairs`."""
    check_kind(kind)
    poses, true = check_pair(estimate, truth)
    first, second = pose_pairs(true, **which).T
    laid = true[first] @ invert(poses[first]) @ poses[second]
    return _state_errors(laid, true[second], kind)


def _state_errors(poses: Float64, true: Float64, kind: str) -> Float64:
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    turned = true[:, :3, :3] @ np.swapaxes(R, 1, 2)
    if kind == "rotation":
        return rotation_angles(turned)
    return np.linalg.norm(true[:, :3, 3] - np.einsum("nij,nj->ni", turned, p), axis=1)
