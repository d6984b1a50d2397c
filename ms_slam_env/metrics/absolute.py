"""Absolute errors of estimated trajectories (ATE), of position and of orientation.

Sources: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Qu, Zhang,
Yang, Dong, "USME", Navigation Positioning and Timing 2021, equations (1) and (2). With R_i, p_i the
true pose and R'_i, p'_i the estimate after alignment, the errors at pose i are |p_i - p'_i| and the
angle of R_i^T R'_i; ATE is their root mean square. (USME's (1), which our text of it lacks, is
usually written with p_i - dR_i p'_i, dR_i = R_i R'_i^T; that depends on where the world has its
origin, and no tool computes it.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry.point_clouds import umeyama
from ms_slam_env.metrics.trajectory import (
    ErrorStatistics,
    check_kind,
    check_lengths,
    check_poses,
    check_positions,
    rotation_angles,
    statistics_of,
)

Float64 = NDArray[np.float64]

ALIGNMENTS = ("se3", "sim3", "none")


@dataclass(frozen=True)
class Alignment:
    """Similarity that takes an estimate to the truth: x_truth = scale R x_estimate + t.

    Attributes:
        R: (3, 3).
        t: (3,) metres.
        scale: 1 unless it was asked for.
        unique: whether one rotation is the best; positions on a line, or in a point, leave it open.
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


def find_alignment(estimate: ArrayLike, truth: ArrayLike, align: str = "se3") -> Alignment:
    """Best alignment of positions, in the sense of least squares (Umeyama, PAMI 1991).

    Args:
        estimate: T_world_camera (N, 4, 4), or positions (N, 3).
        truth: likewise, corresponding by row.
        align: ``se3`` (best rigid motion), ``sim3`` (and scale) or ``none``.

    Raises:
        InputError: wrong shapes, no poses, lengths that differ, NaN, unknown alignment; ``sim3``
            of an estimate that stands still.
    """
    if align not in ALIGNMENTS:
        raise unknown("alignment", align, ALIGNMENTS)
    positions, true_positions = (
        check_positions(estimate, "estimate"),
        check_positions(truth, "truth"),
    )
    check_lengths(positions, true_positions)
    if align == "none":
        return Alignment(np.eye(3), np.zeros(3), 1.0, unique=True)
    R, t, scale = umeyama(positions, true_positions, with_scale=align == "sim3")
    centred = true_positions - true_positions.mean(axis=0)
    spread = np.linalg.svd(centred.T @ (positions - positions.mean(axis=0)), compute_uv=False)
    return Alignment(R, t, scale, unique=bool(spread[1] > 1e-12 * max(spread[0], 1e-12)))


def absolute_errors(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", kind: str = "translation"
) -> Float64:
    """Errors (N,) of the poses after alignment of the positions, USME equation (1).

    Args:
        estimate: T_world_camera (N, 4, 4); positions (N, 3) do for ``translation``.
        truth: likewise, corresponding by row.
        align: ``se3`` (best rigid motion), ``sim3`` (and scale) or ``none``.
        kind: ``translation``, metres, or ``rotation``, radians.

    Raises:
        InputError: as `find_alignment`; an unknown kind; ``rotation`` after an alignment whose
            rotation is open, because the positions lie on a line.
    """
    check_kind(kind)
    if kind == "rotation":
        poses, true_poses = check_poses(estimate, "estimate"), check_poses(truth, "truth")
        found = find_alignment(poses, true_poses, align)
        if not found.unique:
            raise InputError(
                "positions on a line leave the alignment of orientations open; align='none' works"
            )
        relative = np.swapaxes(true_poses[:, :3, :3], 1, 2) @ found.poses(poses)[:, :3, :3]
        return rotation_angles(relative)
    found = find_alignment(estimate, truth, align)
    positions = found.positions(check_positions(estimate, "estimate"))
    return np.linalg.norm(positions - check_positions(truth, "truth"), axis=1)


def ate_statistics(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", kind: str = "translation"
) -> ErrorStatistics:
    """Statistics of the absolute trajectory error (m or rad); arguments of `absolute_errors`."""
    return statistics_of(absolute_errors(estimate, truth, align, kind))


def ate_rmse(
    estimate: ArrayLike, truth: ArrayLike, align: str = "se3", kind: str = "translation"
) -> float:
    """Absolute trajectory error (m or rad), USME equation (2): the root mean square.

    Arguments of `absolute_errors`.
    """
    return ate_statistics(estimate, truth, align, kind).rmse
