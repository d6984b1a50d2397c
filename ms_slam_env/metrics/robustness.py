"""Robustness of tracking: do the pieces of a trajectory between losses fit together?

Source: Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation
Positioning and Timing 2021, equations (9) and (10); after Li et al., "Survey and evaluation of
monocular visual-inertial SLAM algorithms for augmented reality", 2019.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import logm

from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import check_pose
from ms_slam_env.geometry.point_clouds import umeyama

Float64 = NDArray[np.float64]

SEGMENT_ALIGNMENTS = ("se3", "sim3")


@dataclass(frozen=True)
class TrackingRobustness:
    """How well the tracked pieces of a trajectory fit together.

    Attributes:
        error: USME equation (10), the sum over neighbouring pieces of |log(xi_i^-1 xi_i+1)|;
            metres, radians and, with scale, the logarithm of scales are summed as they are.
        translation_m: its translation parts alone.
        rotation_rad: its rotation parts alone.
        log_scale: its scale parts alone.
        segments: (K, 2) first frame and frame after the last of each piece.
        lost: share of the frames outside the pieces.
    """

    error: float
    translation_m: float
    rotation_rad: float
    log_scale: float
    segments: NDArray[np.int64]
    lost: float


def tracked_segments(tracked: ArrayLike, shortest: int = 3) -> NDArray[np.int64]:
    """Runs of tracked frames, (K, 2): first frame and frame after the last.

    Args:
        tracked: (N,) bool.
        shortest: runs of fewer frames are left out.

    Raises:
        InputError: another shape, or no frame.
    """
    flags = np.asarray(tracked)
    if flags.ndim != 1 or flags.dtype != np.bool_ or len(flags) == 0:
        raise InputError(f"tracked must be (N,) bool, got {flags.shape} {flags.dtype}")
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    segments = edges.reshape(-1, 2)
    return segments[segments[:, 1] - segments[:, 0] >= shortest]


def tracking_robustness(
    estimate: ArrayLike,
    truth: ArrayLike,
    tracked: ArrayLike,
    align: str = "se3",
    lever_m: float = 1.0,
) -> TrackingRobustness:
    """Align every tracked piece with the truth and compare neighbouring alignments.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise.
        tracked: (N,) bool, whether the frame was tracked.
        align: ``se3``, or ``sim3`` for systems without scale.
        lever_m: a pose counts with its position and with the three points this far along its
            axes. 0 is USME's equation (9), positions alone, which leaves the roll of a straight
            piece, and the rotation of one that rests, open.

    Raises:
        InputError: bad poses, lengths that differ, an unknown alignment, a negative lever, no
            piece of at least 3 frames; ``sim3`` of a piece in which either stands still.
    """
    if align not in SEGMENT_ALIGNMENTS:
        raise unknown("alignment", align, SEGMENT_ALIGNMENTS)
    if not (np.isfinite(lever_m) and lever_m >= 0):
        raise InputError(f"lever_m must be finite and >= 0, got {lever_m}")
    poses = np.stack([check_pose(T, "estimate") for T in np.asarray(estimate, dtype=np.float64)])
    true_poses = np.stack([check_pose(T, "truth") for T in np.asarray(truth, dtype=np.float64)])
    segments = tracked_segments(tracked)
    if not len(poses) == len(true_poses) == len(np.asarray(tracked)):
        raise InputError(
            f"estimate has {len(poses)} poses, truth {len(true_poses)}, tracked "
            f"{len(np.asarray(tracked))} flags; they must correspond"
        )
    if len(segments) == 0:
        raise InputError("no piece of at least 3 frames was tracked")
    similarities = []
    for first, end in segments:
        own, true = poses[first:end], true_poses[first:end]
        scale = umeyama(own[:, :3, 3], true[:, :3, 3], True)[2] if align == "sim3" else 1.0
        if not scale > 0:
            raise InputError(f"the truth stands still in frames {first} to {end - 1}: no scale")
        points = _levers(own, lever_m / scale)
        R, t, scale = umeyama(points, _levers(true, lever_m), align == "sim3")
        similarities.append(_similarity(R, t, scale))  # (9)
    parts = np.array(
        [similarity_log(np.linalg.inv(a) @ b) for a, b in itertools.pairwise(similarities)]
    ).reshape(-1, 7)
    covered = int((segments[:, 1] - segments[:, 0]).sum())
    return TrackingRobustness(
        error=float(np.linalg.norm(parts, axis=1).sum()),  # (10)
        translation_m=float(np.linalg.norm(parts[:, :3], axis=1).sum()),
        rotation_rad=float(np.linalg.norm(parts[:, 3:6], axis=1).sum()),
        log_scale=float(np.abs(parts[:, 6]).sum()),
        segments=segments,
        lost=1.0 - covered / len(poses),
    )


def similarity_log(S: ArrayLike) -> Float64:
    """Twist (7,) of a similarity (4, 4) [[s R, t], [0, 1]]: rho (m), phi (rad), log s.

    Unique for rotations below pi.
    """
    generator = np.real(logm(np.asarray(S, dtype=np.float64)))
    phi = [generator[2, 1], generator[0, 2], generator[1, 0]]
    return np.array([*generator[:3, 3], *phi, np.trace(generator[:3, :3]) / 3])


def _similarity(R: Float64, t: Float64, scale: float) -> Float64:
    S = np.eye(4)
    S[:3, :3], S[:3, 3] = scale * R, t
    return S


def _levers(poses: Float64, lever_m: float) -> Float64:
    """Points (4 N, 3): the positions of poses and the points along their axes."""
    position = poses[:, None, :3, 3]
    axes = np.swapaxes(poses[:, :3, :3], 1, 2)
    return np.concatenate([position, position + lever_m * axes], axis=1).reshape(-1, 3)
