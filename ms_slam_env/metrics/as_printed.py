"""USME's equations (1), (2), (4) and (5) to the letter, beside `absolute_errors` and the like.

Qu, Zhang, Yang, Dong, "USME", Navigation Positioning and Timing 2021, sections 1.1 (1) and (2). The
typeset formulas are missing from the text that we have; its words (the rotation dR_i between
estimated and true state, N states, pairs d_k = {x_s, x_e} with e > s) are those of Zhang and
Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", IROS
2018, whose formulas these are:

    dR_i = R_i R'_i^T,   dp_i = p_i - dR_i p'_i                                     (1)
    ATE_rot = sqrt(1/N sum |angle(dR_i)|^2),   ATE_pos = sqrt(1/N sum |dp_i|^2)     (2)
    RE = {the same of x_e, after x'_s was laid onto x_s}                            (4), (5)

with R, p the truth and R', p' the estimate after alignment. dp_i is no distance between positions:
an error of orientation moves it by as much as the camera is away from the world's origin, so that
the same trajectories in another world have another error. `ate_rmse` has |p_i - p'_i| there, as
all tools do. The angles are the same. (5) is a set, of which (mean, median) statistics are given.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.geometry import Float64, invert
from ms_slam_env.metrics.relative import TOLERANCE, pose_pairs
from ms_slam_env.metrics.trajectory import (
    ErrorStatistics,
    check_kind,
    check_pair,
    find_alignment,
    rotation_angles,
    statistics_of,
)


def printed_errors(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", kind: str = "translation"
) -> Float64:
    """Errors (N,) of USME equation (1), metres or radians; the RMS of them is (2).

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
        align: as `find_alignment`.
        kind: ``translation`` or ``rotation``.

    Raises:
        InputError: as `absolute_errors`.
    """
    check_kind(kind)
    poses, true = check_pair(estimate, truth)
    return _state_errors(find_alignment(poses, true, align).poses(poses), true, kind)


def printed_ate(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", kind: str = "translation"
) -> ErrorStatistics:
    """Statistics of `printed_errors`; ``rmse`` is USME equation (2)."""
    return statistics_of(printed_errors(estimate, truth, align, kind))


def printed_relative_errors(
    estimate: ArrayLike,
    truth: ArrayLike,
    delta: float = 1,
    kind: str = "translation",
    unit: str = "frames",
    times: ArrayLike | None = None,
    pairs: str = "all",
    tolerance: float = TOLERANCE,
) -> Float64:
    """The set (K,) of USME equation (5), metres or radians; arguments of `relative_errors`."""
    check_kind(kind)
    poses, true = check_pair(estimate, truth)
    first, second = pose_pairs(true, delta, unit, times, pairs, tolerance).T
    laid = true[first] @ invert(poses[first]) @ poses[second]
    return _state_errors(laid, true[second], kind)


def _state_errors(poses: Float64, true: Float64, kind: str) -> Float64:
    R, p = poses[:, :3, :3], poses[:, :3, 3]
    turned = true[:, :3, :3] @ np.swapaxes(R, 1, 2)
    if kind == "rotation":
        return rotation_angles(turned)
    return np.linalg.norm(true[:, :3, 3] - np.einsum("nij,nj->ni", turned, p), axis=1)
