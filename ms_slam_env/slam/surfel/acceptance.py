"""What aligning a frame with the map found, and whether that is believed: on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.degeneracy import eigen, is_constrained, mat66d, pose_covariance, vec6d
from ms_slam_env.slam.surfel.photometry import BLANK
from ms_slam_env.slam.surfel.solver import (
    cholesky,
    cholesky_solve,
    invert_rigid,
    load_terms,
    orthonormalise,
    se3_exp,
    se3_log,
)

OK = 0
FEW_POINTS = 1
LITTLE_OVERLAP = 2
UNCONSTRAINED = 3
GEOMETRY = 4
APPEARANCE = 5
IMPLAUSIBLE = 6
REASONS = {
    OK: "",
    FEW_POINTS: "too few points of the map or of the frame to align",
    LITTLE_OVERLAP: "the frame hardly overlaps the map's view",
    UNCONSTRAINED: "the view does not constrain the pose",
    GEOMETRY: "the frame's depth does not fit the map",
    APPEARANCE: "the frame's intensity does not fit the map",
    IMPLAUSIBLE: "the motion is implausibly large",
}
STAT_INLIER_FRACTION = 0
STAT_RESIDUAL_M = 1
STAT_OVERLAP = 2
STAT_ALIKE_FRACTION = 3
STAT_APART_FRACTION = 4
STAT_SIGMA = 5  # standard deviation of the worst translation or rotation component
STAT_COST = 6  # mean truncated cost of the visible points, in [0, 3]
STAT_CONFLICT = 7  # chi squared between the poses that the two terms ask for
STAT_DEGENERATE = 8  # number of directions that are not constrained
NUM_STATS = 9


@wp.struct
class Limits:
    """What a tracked frame must satisfy."""

    points: wp.float64  # least number of matched points
    overlap: wp.float64
    inliers: wp.float64
    alike: wp.float64
    apart: wp.float64
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


@wp.kernel
def judge(
    sums: wp.array3d(dtype=wp.float64),
    T_model_live: wp.array2d(dtype=wp.mat44d),  # in, and out where it is degenerate
    predicted: wp.array(dtype=wp.mat44d),  # (B,) T_model_live
    limits: wp.array(dtype=Limits),  # (B,)
    T_world_model: wp.array(dtype=wp.mat44d),  # in: pose of the model view
    T_world_live: wp.array(dtype=wp.mat44d),  # out
    verdict: wp.array(dtype=wp.int32),
    stats: wp.array2d(dtype=wp.float64),
    covariance: wp.array(dtype=mat66d),  # (B,) of the twist xi, T_world_live exp(xi)
):
    """Compare what the alignment explained with the limits; write verdict, figures and pose.

    Along directions that the view leaves open the pose is the predicted one.
    """
    b = wp.tid()
    limit = limits[b]
    one = wp.float64(1.0)
    points = sums[b, 0, 28]
    visible = sums[b, 0, 29]
    matched = sums[b, 0, 30]
    textured = sums[b, 0, 33]
    inlier_fraction = sums[b, 0, 31] / wp.max(matched, one)
    alike_fraction = one
    if textured > wp.float64(50.0):
        alike_fraction = sums[b, 0, 34] / textured
    apart_fraction = sums[b, 0, 35] / wp.max(matched, one)
    overlap = visible / wp.max(points, one)
    cost = sums[b, 0, 27] / wp.max(visible, one)

    A, B, g_a, g_b, length = load_terms(sums, b, 0)
    E = eigen(A + B)
    sigma = wp.float64(0.0)
    degenerate = wp.int32(0)
    for k in range(6):
        if is_constrained(E, k, A, sums[b, 0, 69], matched):
            sigma = wp.max(sigma, one / wp.sqrt(E[6, k]))
        else:
            degenerate += 1

    T = T_model_live[b, 0]
    covariance[b] = pose_covariance(E, A, B, sums[b, 0, 69], matched, length)
    if degenerate > 0:
        # Coarser levels may have moved along what turns out to be open.
        deviation = in_metres_twist(se3_log(invert_rigid(predicted[b]) * T), length)
        for k in range(6):
            if not is_constrained(E, k, A, sums[b, 0, 69], matched):
                along = wp.float64(0.0)
                for i in range(6):
                    along += E[i, k] * deviation[i]
                for i in range(6):
                    deviation[i] -= along * E[i, k]
        T = predicted[b] * se3_exp(in_metres_twist(deviation, one / length))
        T_model_live[b, 0] = T
    distance = wp.sqrt(T[0, 3] * T[0, 3] + T[1, 3] * T[1, 3] + T[2, 3] * T[2, 3])
    cosine = wp.float64(0.5) * (T[0, 0] + T[1, 1] + T[2, 2] - one)

    code = wp.int32(0)
    if matched < limit.points:
        code = 1
    elif overlap < limit.overlap:
        code = 2
    elif sigma > limit.sigma or degenerate > limit.degenerate:
        code = 3
    elif inlier_fraction < limit.inliers or apart_fraction > limit.apart:
        code = 4
    elif alike_fraction < limit.alike or cost > limit.cost:
        code = 5
    elif distance > limit.motion_m or cosine < limit.motion_cos:
        code = 6
    verdict[b] = code
    T_world_live[b] = orthonormalise(T_world_model[b] * T)
    stats[b, 0] = inlier_fraction
    stats[b, 1] = wp.sqrt(sums[b, 0, 32] / wp.max(sums[b, 0, 31], one))
    stats[b, 2] = overlap
    stats[b, 3] = alike_fraction
    stats[b, 4] = apart_fraction
    stats[b, 5] = sigma
    stats[b, 6] = cost
    stats[b, 8] = wp.float64(degenerate)
    stats[b, 7] = _conflict(A, B, g_a, g_b)


_LIMITS_DTYPE = Limits.numpy_dtype()  # type: ignore[attr-defined]


def make_limits(strict: NDArray[np.bool_], lost: NDArray[np.int32]) -> NDArray[Any]:
    """Limits (B,) of ordinary tracking, or ``strict`` ones where a wide search found the pose.

    The motion may be larger the longer, in frames, tracking has been ``lost``.

    Chosen on 800 good and 80 wrong alignments of random walks with steps of 3, 6 and 10 cm and
    degrees in six scenes at 160x120, of which they refused 0.3 % of the good ones. The self-similar
    carpet fits itself at wrong places but for its cost, which is 1.5 there and below 1.3 at right
    ones. With grey values compared at the recording's exposure and scale, they refused 1 of 1,490
    frames of five scenes, hand-held with 4 cm and 2 degrees a frame, whose colour was not
    registered with depth, half of them with exposure jumps, rolling shutter and holes besides.
    """
    limits = np.zeros(len(strict), dtype=_LIMITS_DTYPE)
    limits["points"] = 100.0
    limits["overlap"] = np.where(strict, 0.4, 0.3)
    limits["inliers"] = np.where(strict, 0.7, 0.65)
    limits["alike"] = np.where(strict, 0.75, 0.7)
    limits["apart"] = np.where(strict, 0.12, 0.15)
    limits["cost"] = np.where(strict, 1.3, 1.4)
    limits["sigma"] = 0.04
    limits["degenerate"] = np.where(strict, 0, 5)
    limits["motion_m"] = np.minimum(1.0, 0.3 + 0.1 * lost)
    limits["motion_cos"] = np.cos(np.radians(np.minimum(60.0, 30.0 + 10.0 * lost)))
    return limits


def geometric_limits(lost: NDArray[np.int32]) -> NDArray[Any]:
    """Limits (B,) of an alignment by geometry alone near the expected pose."""
    limits = make_limits(np.ones(len(lost), dtype=bool), lost)
    limits["alike"], limits["cost"], limits["degenerate"] = 0.0, np.inf, 3
    limits["motion_m"], limits["motion_cos"] = 0.15, np.cos(np.radians(10.0))
    return limits


Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Alignment:
    """What ``Tracker.align`` found for B envs.

    Attributes:
        T_world_live: (B, 4, 4) pose after alignment, good or not.
        T_model_live: (B, 4, 4) the same, relative to the pose of the model view.
        verdict: (B,) codes of ``REASONS``; 0 = tracked.
        stats: (B, NUM_STATS) figures behind the verdict.
        photometry: (B,) how the live grey values relate to the model's, ``Photometry`` each.
        covariance: (B, 6, 6) of the twist (rho, phi), metres and radians, with the true pose
            T_world_live exp(twist).
    """

    T_world_live: Float64
    T_model_live: Float64
    verdict: NDArray[np.int32]
    stats: Float64
    photometry: NDArray[Any]
    covariance: Float64

    def replace(self, where: NDArray[np.bool_], other: Alignment) -> Alignment:
        """Take the envs ``where`` (B,) from ``other``."""
        return Alignment(
            T_world_live=np.where(where[:, None, None], other.T_world_live, self.T_world_live),
            T_model_live=np.where(where[:, None, None], other.T_model_live, self.T_model_live),
            verdict=np.where(where, other.verdict, self.verdict),
            stats=np.where(where[:, None], other.stats, self.stats),
            photometry=np.where(where, other.photometry, self.photometry),
            covariance=np.where(where[:, None, None], other.covariance, self.covariance),
        )


def accept_any_fit(alignment: Alignment) -> Alignment:
    """The same with a good verdict wherever there was something to align at all."""
    usable = (alignment.verdict != FEW_POINTS) & (alignment.verdict != BLANK)
    usable &= np.isfinite(alignment.T_world_live).all(axis=(1, 2))
    unusable = np.where(alignment.verdict == BLANK, BLANK, FEW_POINTS)
    return replace(alignment, verdict=np.where(usable, OK, unusable).astype(np.int32))
