"""Relative pose errors (RPE) of estimated trajectories, over pairs of poses and sub-trajectories.

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
    """Index pairs (K, 2) of poses that are ``delta`` apart, USME equation (3).

    Args:
        truth: T_world_camera (N, 4, 4), which distances in metres are measured along.
        delta: distance between the two poses of a pair.
        unit: of ``delta``: ``frames``, ``m`` along the true path, or ``s``.
        times: (N,) seconds, increasing; needed only for ``s``.
        pairs: ``all`` pairs each pose with the later pose whose distance is closest to ``delta``,
            if it deviates by at most ``tolerance`` times ``delta``. ``consecutive`` ends each pair
            at the first pose at least ``delta`` away and begins the next pair there.
        tolerance: for ``all`` in metres or seconds. Frames are counted exactly.

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
    angle of its rotation, radians. No alignment is applied; an estimate without scale must be
    scaled first. For the arguments not listed here see `pose_pairs`.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
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
    """Statistics of the relative pose error (m or rad), from the arguments of `relative_errors`."""
    return statistics_of(errors)


@with_arguments_of(relative_errors)
def rpe_rmse(errors: Float64) -> float:
    """Root mean square of the `relative_errors` (m or rad), USME equation (5); same arguments."""
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
    # The closest later pose is one of the two that enclose the goal.
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
        # Steps of 0.1 s add up to slightly more or less than 1 s.
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
    """Relative errors over sub-trajectories of one length, divided by that length.

    Attributes:
        length_m: length along the true path.
        segments: number of sub-trajectories of this length.
        translation: metres of error per metre of ``length_m``, without unit; times 100 for per
            cent.
        rotation_rad_m: radians of error per metre.
    """

    length_m: float
    segments: int
    translation: ErrorStatistics
    rotation_rad_m: ErrorStatistics


def equal_pieces(count: int, pieces: int) -> Int64:
    """Split ``count`` poses into ``pieces``: (K, 2) first index, and one after the last.

    Lengths differ by at most one pose.

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
    """Relative errors over sub-trajectories of given lengths, one entry per length.

    Source: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark
    suite", CVPR 2012, where lengths are 100 to 800 m and a sub-trajectory begins at every 10th
    frame. It ends at the first pose farther along the true path than its length. Errors of the
    motion, as in `relative_errors`, are divided by the length.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
        lengths_m: metres; None for 10 % to 50 % of the true path (Zhang and Scaramuzza, "A
            tutorial on quantitative trajectory evaluation", IROS 2018).
        every: a sub-trajectory begins at every ``every``-th frame.

    Returns:
        One entry for each length that fits into the path; none if the truth stands still and no
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
    """Errors (N,), m or rad, as Zhang and Scaramuzza define them; arguments of `absolute_errors`.

    They stand for USME's equations (1) to (5). The typeset formulas are missing from our text of
    USME. Its words (the rotation dR_i between estimated and true state, N states, pairs
    d_k = {x_s, x_e} with e > s) match Zhang and
    Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry",
    IROS 2018, so their formulas are used:

        dR_i = R_i R'_i^T,   dp_i = p_i - dR_i p'_i                                     (1)
        ATE_rot = sqrt(1/N sum |angle(dR_i)|^2),   ATE_pos = sqrt(1/N sum |dp_i|^2)     (2)
        RE = {the same at x_e, after aligning x'_s with x_s}                            (4), (5)

    with R, p the truth and R', p' the estimate after alignment. dp_i is not a distance between
    positions: an orientation error changes it in proportion to the camera's distance from the
    world origin, so the same trajectories in another world frame have another error. `ate_rmse`
    uses |p_i - p'_i| instead, as other tools do. The angles are the same.
    """
    check_kind(kind)
    poses, true = check_pair(estimate, truth)
    return _state_errors(find_alignment(poses, true, align).poses(poses), true, kind)


@with_arguments_of(printed_errors)
def printed_ate(errors: Float64) -> ErrorStatistics:
    """Statistics of `printed_errors`; ``rmse`` stands for USME equation (2)."""
    return statistics_of(errors)


def printed_relative_errors(
    estimate: ArrayLike, truth: ArrayLike, kind: str = "translation", **which: Any
) -> Float64:
    """Relative errors (K,), m or rad, as `printed_errors`; ``which``: options of `pose_pairs`."""
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
