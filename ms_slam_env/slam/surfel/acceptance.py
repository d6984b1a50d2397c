"""The result of aligning a frame with the map, and its acceptance test on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.geometry import adjoint, invert
from ms_slam_env.slam.shared.alignment_check import (
    AcceptanceThresholds,
    AlignmentStatistics,
    DeviceStatistics,
    DeviceThresholds,
    TrackingStatus,
    evaluate_alignment,
    evaluate_on_device,
)
from ms_slam_env.slam.surfel.normal_equations import Hypotheses, Sum
from ms_slam_env.slam.surfel.solver import (
    cholesky,
    cholesky_solve,
    eigen,
    invert_rigid,
    is_constrained,
    load_terms,
    mat66d,
    mat76d,
    orthonormalise,
    pose_covariance,
    se3_exp,
    se3_log,
    vec6d,
)
from ms_slam_env.slam.surfel.surfel_config import AcceptanceConfig


@wp.func
def _squared_norm(H: mat66d, g: vec6d) -> wp.float64:
    """Value of g^T H^-1 g."""
    L = cholesky(H)
    total = wp.float64(0.0)
    if L[0, 0] > wp.float64(0.0):
        x = cholesky_solve(L, g)
        for i in range(6):
            total += x[i] * g[i]
    return total


@wp.func
def _conflict(A: mat66d, B: mat66d, g_a: vec6d, g_b: vec6d) -> wp.float64:
    """Chi squared of the difference between the minima of the geometric and photometric terms.

    min (x - x_a)^T A (x - x_a) + (x - x_b)^T B (x - x_b): the extra cost of the joint minimum over
    the minimum of each term. A prior of 5 cm holds a term without information at zero.
    """
    for i in range(6):
        A[i, i] += wp.float64(400.0)
        B[i, i] += wp.float64(400.0)
    return _squared_norm(A, g_a) + _squared_norm(B, g_b) - _squared_norm(A + B, g_a + g_b)


@wp.func
def in_metres_twist(xi: vec6d, length: wp.float64) -> vec6d:
    """Twist with its rotation times ``length``."""
    scaled = xi
    for i in range(3, 6):
        scaled[i] = xi[i] * length
    return scaled


@wp.func
def _ratio(sums: wp.array3d[wp.float64], b: int, part: int, whole: int) -> wp.float64:
    """Ratio of two sums of env b; the second one is a count."""
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
) -> wp.mat44d:
    """The pose T with its unconstrained directions replaced by those of the predicted pose.

    Coarser levels may have moved along a direction that turns out to be unconstrained.
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
def assess_alignment(
    hypotheses: Hypotheses,  # (B, 1); out: the pose, if degenerate
    predicted: wp.array[wp.mat44d],  # (B,) T_model_live
    thresholds: wp.array[DeviceThresholds],  # (B,)
    T_world_model: wp.array[wp.mat44d],  # in: pose of the model view
    T_world_live: wp.array[wp.mat44d],  # out
    status: wp.array[wp.int32],
    statistics: wp.array[DeviceStatistics],
    covariance: wp.array[mat66d],  # (B,) of the twist xi, T_world_live exp(xi)
) -> None:
    """Compare the alignment with the thresholds; write its status, statistics and pose.

    Along directions that the view does not constrain, the pose is the predicted one.
    """
    b = wp.tid()
    one = wp.float64(1.0)
    sums = hypotheses.sums
    matched = sums[b, 0, Sum.MATCHED]
    tilted = sums[b, 0, Sum.TILTED]
    found = DeviceStatistics()
    found.matches = matched
    found.overlap = _ratio(sums, b, Sum.VISIBLE, Sum.POINTS)
    found.inlier_ratio = _ratio(sums, b, Sum.INLIERS, Sum.MATCHED)
    found.depth_conflict_ratio = _ratio(sums, b, Sum.DEPTH_CONFLICTS, Sum.MATCHED)
    found.photometric_inlier_ratio = one
    if sums[b, 0, Sum.TEXTURED] > wp.float64(50.0):
        found.photometric_inlier_ratio = _ratio(sums, b, Sum.PHOTOMETRIC_INLIERS, Sum.TEXTURED)
    found.residual_m = wp.sqrt(_ratio(sums, b, Sum.SQUARED_M2, Sum.INLIERS))
    found.cost = _ratio(sums, b, Sum.COST, Sum.VISIBLE)

    A, B, g_a, g_b, length = load_terms(sums, b, 0)
    E = eigen(A + B)
    for k in range(6):
        if is_constrained(E, k, A, tilted, matched):
            found.sigma_m = wp.max(found.sigma_m, one / wp.sqrt(E[6, k]))
        else:
            found.degenerate_directions += one
    found.term_conflict = _conflict(A, B, g_a, g_b)
    covariance[b] = pose_covariance(E, A, B, tilted, matched, length)

    T = hypotheses.pose[b, 0]
    if found.degenerate_directions > wp.float64(0.0):
        T = _without_open_directions(T, predicted[b], E, A, tilted, matched, length)
        hypotheses.pose[b, 0] = T
    found.motion_m = wp.sqrt(T[0, 3] * T[0, 3] + T[1, 3] * T[1, 3] + T[2, 3] * T[2, 3])
    found.rotation_cos = wp.float64(0.5) * (T[0, 0] + T[1, 1] + T[2, 2] - one)

    status[b] = evaluate_on_device(found, thresholds[b])
    T_world_live[b] = orthonormalise(T_world_model[b] * T)
    statistics[b] = found


_RATIOS = ("inlier_ratio", "photometric_inlier_ratio")
FARTHEST_M, FARTHEST_DEG = 0.3, 30.0  # from frame to frame
LARGEST_SIGMA = 0.04  # (metres, radians) of the worst direction that the view constrains


def acceptance_thresholds(
    config: AcceptanceConfig, strict: NDArray[np.bool_], lost: NDArray[np.int32]
) -> NDArray[Any]:
    """Thresholds (B,) for ordinary tracking, or ``strict`` ones for poses found by a wide search.

    Ordinary thresholds are those of ``config``; strict ones are never laxer. The allowed motion
    grows with the number of frames for which tracking has been ``lost``.

    They were chosen on 800 good and 80 wrong alignments of random walks with steps of 3, 6 and
    10 cm and degrees in six scenes at 160x120; they refused 0.3 % of the good ones. A self-similar
    carpet fits itself at wrong places in all but its cost: 1.5 there, below 1.3 at right places.
    With grey values compared at the recording's exposure and scale, they refused 1 of 1,490 frames
    of five hand-held scenes (4 cm and 2 degrees a frame, colour not registered with depth; half of
    the frames also had exposure jumps, rolling shutter and holes).
    """
    return _acceptance_thresholds(config, tuple(strict.tolist()), tuple(lost.tolist())).copy()


@lru_cache(maxsize=64)
def _acceptance_thresholds(
    config: AcceptanceConfig, strict: tuple[bool, ...], lost: tuple[int, ...]
) -> NDArray[Any]:
    least = {"overlap": config.overlap, "inlier_ratio": config.inliers}
    least["photometric_inlier_ratio"] = config.alike
    most = {"depth_conflict_ratio": config.conflicts, "cost": config.cost}
    ordinary = AcceptanceThresholds(config.points, sigma_m=LARGEST_SIGMA, **least, **most)
    thresholds = ordinary.repeated(len(strict))
    for name, value in least.items():
        thresholds[name] = np.where(strict, max(_STRICT[name], value), value)
    for name, value in most.items():
        thresholds[name] = np.where(strict, min(_STRICT[name], value), value)
    thresholds["degenerate_directions"] = np.where(strict, 0, 5)
    thresholds["motion_m"] = np.minimum(1.0, FARTHEST_M + 0.1 * np.array(lost))
    most_deg = np.minimum(60.0, FARTHEST_DEG + 10.0 * np.array(lost))
    thresholds["rotation_cos"] = np.cos(np.radians(most_deg))
    return thresholds


_STRICT = {
    "overlap": 0.4,
    "inlier_ratio": 0.7,
    "photometric_inlier_ratio": 0.75,
    "depth_conflict_ratio": 0.12,
    "cost": 1.3,
}


_FIT = ("cost", "depth_conflict_ratio", *_RATIOS)
USUAL = np.dtype([(name, np.float64) for name in (*_FIT, "surprise")])
"""What alignments are like that were accepted of late: of a recording's own noise.

``surprise`` is the difference between motion and expected motion: the larger of metres and radians.
"""
_FOLLOWS = 0.1  # share of the way from what is usual to the last frame
_EXPECTED = {
    "cost": 1.05,
    "depth_conflict_ratio": 0.03,
    "inlier_ratio": 0.9,
    "photometric_inlier_ratio": 0.85,
}
_LARGEST = {"cost": 1.9, "depth_conflict_ratio": 0.25}  # that noise makes acceptable
_SMALLEST_RATIO = 0.5


def fit_of_noise(batch: int) -> NDArray[Any]:
    """What is usual (B,) with the noise that ``SurfelConfig`` expects."""
    usual = np.ones(batch, dtype=USUAL)
    usual["depth_conflict_ratio"] = 0.0
    return usual


def follow_usual(usual: NDArray[Any], statistics: NDArray[Any], surprise: Float64) -> NDArray[Any]:
    """What is ``usual`` (B,) after frames that were accepted, with these figures (B,)."""
    after = usual.copy()
    for name in _FIT:
        after[name] += _FOLLOWS * (statistics[name] - usual[name])
    after["surprise"] += _FOLLOWS * (surprise - usual["surprise"])
    return after


def at_usual_noise(thresholds: NDArray[Any], usual: NDArray[Any]) -> NDArray[Any]:
    """Relax thresholds (B,) by the noise that the running statistics ``usual`` (B,) show.

    ``acceptance_thresholds`` suit the noise of a rendered Kinect; ``_EXPECTED`` holds its worst
    usual values. A HoloLens or a real Kinect has a usual cost of 1.2 to 1.3, so its thresholds are
    relaxed by the difference.
    """
    relaxed = thresholds.copy()
    for name, largest in _LARGEST.items():
        excess = np.maximum(usual[name] - _EXPECTED[name], 0.0)
        most = np.maximum(thresholds[name], largest)
        relaxed[name] = np.minimum(thresholds[name] + excess, most)
    for name in _RATIOS:
        lack = np.maximum(_EXPECTED[name] - usual[name], 0.0)
        least = np.minimum(thresholds[name], _SMALLEST_RATIO)
        relaxed[name] = np.maximum(thresholds[name] - lack, least)
    return relaxed


def geometric_thresholds(config: AcceptanceConfig, lost: NDArray[np.int32]) -> NDArray[Any]:
    """Thresholds (B,) for an alignment by geometry alone near the expected pose."""
    thresholds = acceptance_thresholds(config, np.ones(len(lost), dtype=bool), lost)
    thresholds["photometric_inlier_ratio"], thresholds["cost"] = 0.0, np.inf
    thresholds["degenerate_directions"] = 3
    thresholds["motion_m"], thresholds["rotation_cos"] = 0.15, np.cos(np.radians(10.0))
    return thresholds


@dataclass(frozen=True)
class Alignment:
    """The result of ``Tracker.align`` for B envs."""

    T_world_live: Float64  # (B, 4, 4) pose after alignment, accepted or not
    T_model_live: Float64  # (B, 4, 4) that pose relative to the pose of the model view
    status: NDArray[np.int32]  # (B,) ``TrackingStatus``
    statistics: NDArray[Any]  # (B,) figures behind the status, ``AlignmentStatistics`` each
    # (B,) relation of the live grey values to the model's, ``Photometry`` each.
    photometry: NDArray[Any]
    # (B, 6, 6) of the twist (rho, phi), metres and radians, with the true pose T_world_live
    # exp(twist).
    covariance: Float64
    thresholds: NDArray[Any]  # (B,) what was demanded, ``AcceptanceThresholds`` each

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Which envs (B,) have an accepted pose."""
        return self.status == TrackingStatus.OK

    @property
    def uncertain(self) -> NDArray[np.bool_]:
        """Which envs (B,) have a doubtful pose."""
        return self.status == TrackingStatus.UNCERTAIN

    def status_under(self, thresholds: AcceptanceThresholds, env: int) -> TrackingStatus:
        """Status of an env's alignment under other thresholds."""
        found = AlignmentStatistics(*self.statistics[env].tolist())
        return TrackingStatus(evaluate_alignment(found, thresholds))

    def with_status(self, where: NDArray[np.bool_], status: TrackingStatus) -> Alignment:
        """A copy with another status for the envs ``where`` (B,)."""
        if not where.any():
            return self
        return replace(self, status=np.where(where, status, self.status))

    def doubtful_at(self, poses: Float64, photometry: NDArray[Any]) -> Alignment:
        """A copy, uncertain and at other poses (B, 4, 4), about which the map says nothing."""
        return replace(
            self,
            T_world_live=poses,
            status=np.full_like(self.status, TrackingStatus.UNCERTAIN),
            photometry=photometry,
            covariance=np.zeros_like(self.covariance),
        )

    def seen_from(self, T_world_model: Float64) -> Alignment:
        """A copy relative to other poses (B, 4, 4) of the model view."""
        return replace(self, T_model_live=invert(T_world_model) @ self.T_world_live)

    def replace(self, where: NDArray[np.bool_], other: Alignment) -> Alignment:
        """Take the envs ``where`` (B,) from ``other``."""

        def picked(own: NDArray[Any], others: NDArray[Any]) -> NDArray[Any]:
            return np.where(where.reshape(-1, *[1] * (own.ndim - 1)), others, own)

        return Alignment(*map(picked, vars(self).values(), vars(other).values()))


DOUBT_M, DOUBT_RAD = 0.03, 0.02
"""Standard deviations that a frame in doubt adds to a pose, per axis."""


def is_nearly_accepted(
    alignment: Alignment, env: int, config: AcceptanceConfig, usual: NDArray[Any]
) -> bool:
    """Whether a refused alignment passes somewhat laxer thresholds and deserves a closer look.

    ``usual`` (1,) holds the running statistics of the env.
    """
    doubted = config.doubted
    thresholds = AcceptanceThresholds(
        matches=config.points,
        overlap=config.overlap,
        inlier_ratio=min(doubted.inliers, config.inliers),
        depth_conflict_ratio=max(doubted.conflicts, config.conflicts),
        photometric_inlier_ratio=min(doubted.alike, config.alike),
        cost=max(doubted.cost, config.cost),
        sigma_m=LARGEST_SIGMA,
    )
    relaxed = AcceptanceThresholds(*at_usual_noise(thresholds.repeated(1), usual)[0].tolist())
    return alignment.status_under(relaxed, env) == TrackingStatus.OK


def doubt(frames: NDArray[np.int32]) -> Float64:
    """What is added to the covariances (B, 6, 6) of poses uncertain for ``frames`` (B,)."""
    per_frame: Float64 = np.diag([DOUBT_M**2] * 3 + [DOUBT_RAD**2] * 3)
    return per_frame * frames[:, None, None]


NOISE_POWER = 3.0
"""Of the usual cost, over ``_EXPECTED``, by which covariances grow.

The cost is truncated, so it grows more slowly than noise. Chosen on rooms with seeds 1000 and 2.5
or 4 times a Kinect's noise, where the errors of motions ask for powers of 2.6 to 4.
"""


def covariance_at_noise(alignment: Alignment, usual: NDArray[Any]) -> Alignment:
    """Scale covariances to the noise of recordings that usually fit as ``usual`` (B,) says.

    Those of the alignments suit the noise that ``SurfelConfig`` expects.
    """
    excess = np.maximum(usual["cost"] / _EXPECTED["cost"], 1.0)
    if (excess == 1.0).all():
        return alignment
    factor = excess[:, None, None] ** NOISE_POWER
    return replace(alignment, covariance=factor * alignment.covariance)


REPLACED_PX = 350.0
"""Focal length, pixels, at which new surface inherits one alignment's covariance.

Errors of successive alignments are alike, the more so the larger the pixels. Chosen on five rooms
with seeds 1000 at 100x75, 160x120 and 320x240, 150 hand-held frames each. With seeds 2000, 55, 90
and 92 % of the errors of poses in the world then lie where 50, 90 and 95 % are promised; without
drift 3, 9 and 12 %.
"""


def follow_drift(
    drift: Float64, alignment: Alignment, moved: NDArray[np.bool_], focal_px: float
) -> tuple[Float64, Float64]:
    """Drift of maps where frames were aligned with them, and with what these frames map.

    Surface is placed as well as the frame that mapped it first, so what comes into view inherits
    the error of its alignment. A map of one frame has that frame's noise.

    Args:
        drift: (B, 6, 6) covariances of where the maps lie in the world, as twists of the cameras.
        alignment: of the next frames.
        moved: (B,) whose camera is at the pose that the alignment found.
        focal_px: focal length of the frames.

    Returns:
        Drift (B, 6, 6) as twists of the cameras now, and the same for the frames that follow.
    """
    here, after = drift.copy(), drift.copy()
    if not moved.any():
        return here, after
    whose: slice | NDArray[np.bool_] = slice(None) if moved.all() else moved
    added = alignment.covariance[whose]
    carry = adjoint(invert(alignment.T_model_live[whose]))
    found = drift[whose]
    is_first = found[:, 0, 0] == 0
    found = carry @ found @ carry.swapaxes(1, 2)
    if is_first.any():
        found[is_first] = added[is_first]
    new = (1.0 - alignment.statistics["overlap"][whose]) * (REPLACED_PX / focal_px) ** 2
    # What is doubted is not mapped.
    share = np.minimum(new, 1.0) * ~(is_first | alignment.uncertain[whose])
    here[whose] = found
    after[whose] = found + share[:, None, None] * added
    return here, after


def accept_any_fit(alignment: Alignment) -> Alignment:
    """A copy with status OK wherever there was anything to align."""
    is_blank = alignment.status == TrackingStatus.BLANK
    usable = (alignment.status != TrackingStatus.FEW_POINTS) & ~is_blank
    usable &= np.isfinite(alignment.T_world_live).all(axis=(1, 2))
    unusable = np.where(is_blank, TrackingStatus.BLANK, TrackingStatus.FEW_POINTS)
    return replace(alignment, status=np.where(usable, TrackingStatus.OK, unusable).astype(np.int32))
