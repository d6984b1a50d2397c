"""Errors by the piece: of equal pieces of a trajectory, and over lengths of its path.

USME (Qu, Zhang, Yang, Dong, Navigation Positioning and Timing 2021) takes relative errors over
sub-trajectories, equations (3) to (5), so that they can be told apart by piece and by length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.metrics.relative import motion_errors
from ms_slam_env.metrics.trajectory import (
    ErrorStatistics,
    check_lengths,
    check_poses,
    path_distances,
    statistics_of,
)

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

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
    if isinstance(pieces, bool) or not isinstance(pieces, (int, np.integer)) or pieces < 1:
        raise InputError(f"segments must be an integer >= 1, got {pieces!r}")
    if pieces > count:
        raise InputError(f"{count} poses cannot be cut into {pieces} segments")
    edges = np.arange(pieces + 1) * count // pieces
    return np.stack([edges[:-1], edges[1:]], axis=1)


def drifts(
    estimate: ArrayLike,
    truth: ArrayLike,
    lengths_m: Sequence[float] | None = None,
    every: int = 1,
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
    poses, true_poses = check_poses(estimate, "estimate"), check_poses(truth, "truth")
    check_lengths(poses, true_poses)
    if isinstance(every, bool) or not isinstance(every, (int, np.integer)) or every < 1:
        raise InputError(f"every must be an integer >= 1, got {every!r}")
    along = path_distances(true_poses[:, :3, 3])
    if lengths_m is None:
        lengths_m = [share * float(along[-1]) for share in LENGTH_SHARES] if along[-1] > 0 else []
    found = []
    for length in lengths_m:
        if not (np.isfinite(length) and length > 0):
            raise InputError(f"the length of a segment must be finite and > 0 m, got {length}")
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
