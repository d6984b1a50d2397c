"""What aligning a frame with the map found, and whether that is believed: on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.surfel.degeneracy import (
    eigen,
    is_constrained,
    mat66d,
    mat76d,
    pose_covariance,
    vec6d,
)
from ms_slam_env.slam.surfel.normal_equations import Sum
from ms_slam_env.slam.surfel.solver import (
    cholesky,
    cholesky_solve,
    invert_rigid,
    load_terms,
    orthonormalise,
    se3_exp,
    se3_log,
)


class TrackingStatus(IntEnum):
    """Whether a frame was tracked, or else what was wrong; ``REASONS`` has the words."""

    OK = 0
    FEW_POINTS = 1
    LITTLE_OVERLAP = 2
    UNCONSTRAINED = 3
    GEOMETRY = 4
    APPEARANCE = 5
    IMPLAUSIBLE = 6
    INVALID_FRAME = 100


REASONS = {
    TrackingStatus.OK: "",
    TrackingStatus.FEW_POINTS: "too few points of the map or of the frame to align",
    TrackingStatus.LITTLE_OVERLAP: "the frame hardly overlaps the map's view",
    TrackingStatus.UNCONSTRAINED: "the view does not constrain the pose",
    TrackingStatus.GEOMETRY: "the frame's depth does not fit the map",
    TrackingStatus.APPEARANCE: "the frame's intensity does not fit the map",
    TrackingStatus.IMPLAUSIBLE: "the motion is implausibly large",
    TrackingStatus.INVALID_FRAME: "the image is black or blank",
}


class Stat(IntEnum):
    """Places of the figures behind a status."""

    INLIER_RATIO = 0
    RESIDUAL_M = 1
    OVERLAP = 2
    PHOTOMETRIC_INLIER_RATIO = 3
    DEPTH_CONFLICT_RATIO = 4
    SIGMA = 5  # standard deviation of the worst translation or rotation component
    COST = 6  # mean truncated cost of the visible points, in [0, 3]
    TERM_CONFLICT = 7  # chi squared between the poses that the two terms ask for
    DEGENERATE = 8  # number of directions that are not constrained


NUM_STATS = len(Stat)


@wp.struct
class AcceptanceThresholds:
    """What a tracked frame must satisfy."""

    points: wp.float64  # least number of matched points
    overlap: wp.float64
    inliers: wp.float64  # least ratio
    photometric_inliers: wp.float64  # least ratio
    depth_conflicts: wp.float64  # largest ratio
    cost: wp.float64
    sigma: wp.float64  # metres, in the worst of the constrained directions
    degenerate: wp.int32  # most directions that may be unconstrained
    motion_m: wp.float64
    motion_cos: wp.float64


@wp.func
def _squared_norm(H: mat66d, g: vec6d):
    """Value of g^T H^-1 g."""
    L = cholesky(H)
    total = wp.float64(0.0)
    if L[0, 0] > wp.float64(0.0):
        x = cholesky_solve(L, g)
        for i in range(6):
            total += x[i] * g[i]
    return total


@wp.func
def _conflict(A: mat66d, B: mat66d, g_a: vec6d, g_b: vec6d):
    """Chi squared of the difference between the minima of the geometric and photometric terms.

    min (x - x_a)^T A (x - x_a) + (x - x_b)^T B (x - x_b): what the joint minimum costs more than
    each term at its own. A prior of 5 cm keeps a term without information at home.
    """
    for i in range(6):
        A[i, i] += wp.float64(400.0)
        B[i, i] += wp.float64(400.0)
    return _squared_norm(A, g_a) + _squared_norm(B, g_b) - _squared_norm(A + B, g_a + g_b)


@wp.func
def in_metres_twist(xi: vec6d, length: wp.float64):
    """Twist with its rotation times ``length``."""
    scaled = xi
    for i in range(3, 6):
        scaled[i] = xi[i] * length
    return scaled


@wp.func
def _ratio(sums: wp.array3d(dtype=wp.float64), b: int, part: int, whole: int):
    """Ratio of two sums of env b, of which the second is a count."""
    return sums[b, 0, part] / wp.max(sums[b, 0, whole], wp.float64(1.0))


@wp.func
def _without_open_directions(
    T: wp.mat44d,
    predicted: wp.mat44d,
    E: mat76d,
    A: mat66d,
    tilted: wp.float64,
    matched: wp.float64,
    length: wp.float64,
):
    """The pose T, but the predicted one along the directions that the view leaves open.

    Coarser levels may have moved along what turns out to be open.
    """
    deviation = in_metres_twist(se3_log(invert_rigid(predicted) * T), length)
    for k in range(6):
        if not is_constrained(E, k, A, tilted, matched):
            along = wp.float64(0.0)
            for i in range(6):
                along += E[i, k] * deviation[i]
            for i in range(6):
                deviation[i] -= along * E[i, k]
    return predicted * se3_exp(in_metres_twist(deviation, wp.float64(1.0) / length))


@wp.kernel
def evaluate_alignment(
    sums: wp.array3d(dtype=wp.float64),
    T_model_live: wp.array2d(dtype=wp.mat44d),  # in, and out where it is degenerate
    predicted: wp.array(dtype=wp.mat44d),  # (B,) T_model_live
    thresholds: wp.array(dtype=AcceptanceThresholds),  # (B,)
    T_world_model: wp.array(dtype=wp.mat44d),  # in: pose of the model view
    T_world_live: wp.array(dtype=wp.mat44d),  # out
    statuses: wp.array(dtype=wp.int32),
    stats: wp.array2d(dtype=wp.float64),
    covariance: wp.array(dtype=mat66d),  # (B,) of the twist xi, T_world_live exp(xi)
):
    """Compare what the alignment explained with the thresholds; write status, figures and pose.

    Along directions that the view leaves open the pose is the predicted one.
    """
    b = wp.tid()
    threshold = thresholds[b]
    one = wp.float64(1.0)
    matched = sums[b, 0, Sum.MATCHED]
    tilted = sums[b, 0, Sum.TILTED]
    inlier_ratio = _ratio(sums, b, Sum.INLIERS, Sum.MATCHED)
    photometric_inlier_ratio = one
    if sums[b, 0, Sum.TEXTURED] > wp.float64(50.0):
        photometric_inlier_ratio = _ratio(sums, b, Sum.PHOTOMETRIC_INLIERS, Sum.TEXTURED)
    depth_conflict_ratio = _ratio(sums, b, Sum.DEPTH_CONFLICTS, Sum.MATCHED)
    overlap = _ratio(sums, b, Sum.VISIBLE, Sum.POINTS)
    cost = _ratio(sums, b, Sum.COST, Sum.VISIBLE)

    A, B, g_a, g_b, length = load_terms(sums, b, 0)
    E = eigen(A + B)
    sigma = wp.float64(0.0)
    degenerate = wp.int32(0)
    for k in range(6):
        if is_constrained(E, k, A, tilted, matched):
            sigma = wp.max(sigma, one / wp.sqrt(E[6, k]))
        else:
            degenerate += 1
    covariance[b] = pose_covariance(E, A, B, tilted, matched, length)

    T = T_model_live[b, 0]
    if degenerate > 0:
        T = _without_open_directions(T, predicted[b], E, A, tilted, matched, length)
        T_model_live[b, 0] = T
    distance = wp.sqrt(T[0, 3] * T[0, 3] + T[1, 3] * T[1, 3] + T[2, 3] * T[2, 3])
    cosine = wp.float64(0.5) * (T[0, 0] + T[1, 1] + T[2, 2] - one)

    status = int(TrackingStatus.OK)
    if matched < threshold.points:
        status = int(TrackingStatus.FEW_POINTS)
    elif overlap < threshold.overlap:
        status = int(TrackingStatus.LITTLE_OVERLAP)
    elif sigma > threshold.sigma or degenerate > threshold.degenerate:
        status = int(TrackingStatus.UNCONSTRAINED)
    elif inlier_ratio < threshold.inliers or depth_conflict_ratio > threshold.depth_conflicts:
        status = int(TrackingStatus.GEOMETRY)
    elif photometric_inlier_ratio < threshold.photometric_inliers or cost > threshold.cost:
        status = int(TrackingStatus.APPEARANCE)
    elif distance > threshold.motion_m or cosine < threshold.motion_cos:
        status = int(TrackingStatus.IMPLAUSIBLE)
    statuses[b] = status
    T_world_live[b] = orthonormalise(T_world_model[b] * T)
    stats[b, Stat.INLIER_RATIO] = inlier_ratio
    stats[b, Stat.RESIDUAL_M] = wp.sqrt(_ratio(sums, b, Sum.SQUARED_M2, Sum.INLIERS))
    stats[b, Stat.OVERLAP] = overlap
    stats[b, Stat.PHOTOMETRIC_INLIER_RATIO] = photometric_inlier_ratio
    stats[b, Stat.DEPTH_CONFLICT_RATIO] = depth_conflict_ratio
    stats[b, Stat.SIGMA] = sigma
    stats[b, Stat.COST] = cost
    stats[b, Stat.TERM_CONFLICT] = _conflict(A, B, g_a, g_b)
    stats[b, Stat.DEGENERATE] = wp.float64(degenerate)


_THRESHOLDS_DTYPE = AcceptanceThresholds.numpy_dtype()  # type: ignore[attr-defined]


def acceptance_thresholds(strict: NDArray[np.bool_], lost: NDArray[np.int32]) -> NDArray[Any]:
    """Thresholds (B,) of ordinary tracking, or ``strict`` ones where a wide search found the pose.

    The motion may be larger the longer, in frames, tracking has been ``lost``.

    Chosen on 800 good and 80 wrong alignments of random walks with steps of 3, 6 and 10 cm and
    degrees in six scenes at 160x120, of which they refused 0.3 % of the good ones. The self-similar
    carpet fits itself at wrong places but for its cost, which is 1.5 there and below 1.3 at right
    ones. With grey values compared at the recording's exposure and scale, they refused 1 of 1,490
    frames of five scenes, hand-held with 4 cm and 2 degrees a frame, whose colour was not
    registered with depth, half of them with exposure jumps, rolling shutter and holes besides.
    """
    thresholds = np.zeros(len(strict), dtype=_THRESHOLDS_DTYPE)
    thresholds["points"] = 100.0
    thresholds["overlap"] = np.where(strict, 0.4, 0.3)
    thresholds["inliers"] = np.where(strict, 0.7, 0.65)
    thresholds["photometric_inliers"] = np.where(strict, 0.75, 0.7)
    thresholds["depth_conflicts"] = np.where(strict, 0.12, 0.15)
    thresholds["cost"] = np.where(strict, 1.3, 1.4)
    thresholds["sigma"] = 0.04
    thresholds["degenerate"] = np.where(strict, 0, 5)
    thresholds["motion_m"] = np.minimum(1.0, 0.3 + 0.1 * lost)
    thresholds["motion_cos"] = np.cos(np.radians(np.minimum(60.0, 30.0 + 10.0 * lost)))
    return thresholds


def geometric_thresholds(lost: NDArray[np.int32]) -> NDArray[Any]:
    """Thresholds (B,) of an alignment by geometry alone near the expected pose."""
    thresholds = acceptance_thresholds(np.ones(len(lost), dtype=bool), lost)
    thresholds["photometric_inliers"], thresholds["cost"] = 0.0, np.inf
    thresholds["degenerate"] = 3
    thresholds["motion_m"], thresholds["motion_cos"] = 0.15, np.cos(np.radians(10.0))
    return thresholds


@dataclass(frozen=True)
class Alignment:
    """What ``Tracker.align`` found for B envs.

    Attributes:
        T_world_live: (B, 4, 4) pose after alignment, good or not.
        T_model_live: (B, 4, 4) the same, relative to the pose of the model view.
        status: (B,) ``TrackingStatus``.
        stats: (B, NUM_STATS) figures behind the status.
        photometry: (B,) how the live grey values relate to the model's, ``Photometry`` each.
        covariance: (B, 6, 6) of the twist (rho, phi), metres and radians, with the true pose
            T_world_live exp(twist).
    """

    T_world_live: Float64
    T_model_live: Float64
    status: NDArray[np.int32]
    stats: Float64
    photometry: NDArray[Any]
    covariance: Float64

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Which envs (B,) have a pose that is accepted."""
        return self.status == TrackingStatus.OK

    def with_status(self, where: NDArray[np.bool_], status: TrackingStatus) -> Alignment:
        """The same with another status for the envs ``where`` (B,)."""
        return replace(self, status=np.where(where, status, self.status))

    def seen_from(self, T_world_model: Float64) -> Alignment:
        """The same, relative to other poses (B, 4, 4) of the model view."""
        return replace(self, T_model_live=invert(T_world_model) @ self.T_world_live)

    def replace(self, where: NDArray[np.bool_], other: Alignment) -> Alignment:
        """Take the envs ``where`` (B,) from ``other``."""
        return Alignment(
            T_world_live=np.where(where[:, None, None], other.T_world_live, self.T_world_live),
            T_model_live=np.where(where[:, None, None], other.T_model_live, self.T_model_live),
            status=np.where(where, other.status, self.status),
            stats=np.where(where[:, None], other.stats, self.stats),
            photometry=np.where(where, other.photometry, self.photometry),
            covariance=np.where(where[:, None, None], other.covariance, self.covariance),
        )


def accept_any_fit(alignment: Alignment) -> Alignment:
    """The same with a good status wherever there was something to align at all."""
    is_invalid = alignment.status == TrackingStatus.INVALID_FRAME
    usable = (alignment.status != TrackingStatus.FEW_POINTS) & ~is_invalid
    usable &= np.isfinite(alignment.T_world_live).all(axis=(1, 2))
    unusable = np.where(is_invalid, TrackingStatus.INVALID_FRAME, TrackingStatus.FEW_POINTS)
    return replace(alignment, status=np.where(usable, TrackingStatus.OK, unusable).astype(np.int32))
