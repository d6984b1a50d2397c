"""Consistency of pose covariances: do they explain the errors that are made?

If the covariance C of an error xi is right and the error Gaussian, its normalised estimation error
squared, NEES = xi^T C^-1 xi, follows the chi-squared distribution with as many degrees of freedom
as xi has dimensions. Source: Bar-Shalom, Li and Kirubarajan, "Estimation with applications to
tracking and navigation" (2001), section 5.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import adjoint, as_numbers, invert, se3_log
from ms_slam_env.metrics.trajectory import check_pair

COVERAGES = {"within_50": 0.5, "within_90": 0.9, "within_95": 0.95}
"""Key of a result to the share of errors that the ellipsoid promises to hold."""
SILENT_M = 0.01
"""A position that is wrong by more, and by more than its covariance explains, misleads."""
SILENT_SIGMAS = 3.0


def pose_twists(estimate: ArrayLike, truth: ArrayLike) -> Float64:
    """Errors (N, 6) of poses as twists xi = (rho, phi), metres and radians, without alignment.

    The true pose is estimate exp(xi), so xi is in the camera's frame, as is the covariance of
    ``TrackResult``.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.

    Raises:
        InputError: wrong shapes, lengths that differ, NaN.
    """
    poses, true_poses = check_pair(estimate, truth)
    relative = invert(poses) @ true_poses
    return np.array([se3_log(T) for T in relative]).reshape(-1, 6)


def _checked(
    estimate: ArrayLike, truth: ArrayLike, covariances: ArrayLike
) -> tuple[Float64, Float64, Float64]:
    """Poses, true poses (N, 4, 4) and covariances (N, 6, 6)."""
    poses, true_poses = check_pair(estimate, truth)
    C = as_numbers(covariances, "covariances")
    if C.shape != (len(poses), 6, 6):
        raise InputError(f"covariances must be ({len(poses)}, 6, 6), got {C.shape}")
    return poses, true_poses, C


def motion_twists(
    estimate: ArrayLike, truth: ArrayLike, covariances: ArrayLike, first: Int64, second: Int64
) -> tuple[Float64, Float64]:
    """Errors (K, 6) of the motions from frames ``first`` to ``second``, and their covariances.

    To first order, with P the estimated motion, the twist of its error is
    xi_second - Ad(P^-1) xi_first. What both poses have in common, such as the drift of the map
    about them, drops out. Both errors are taken as independent; what they share makes the true
    covariance smaller, so coverage is at least what it would be with it.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
        covariances: (N, 6, 6) of the poses' twists; see `pose_twists`.
        first: (K,) indices.
        second: (K,) indices.

    Returns:
        Twists (K, 6) and covariances (K, 6, 6).

    Raises:
        InputError: wrong shapes, lengths that differ, NaN in poses.
    """
    poses, true_poses, C = _checked(estimate, truth, covariances)
    motions = invert(poses[first]) @ poses[second]
    true_motions = invert(true_poses[first]) @ true_poses[second]
    carry = adjoint(invert(motions))
    summed = C[second] + carry @ C[first] @ np.swapaxes(carry, 1, 2)
    return pose_twists(motions, true_motions), summed


def nees(errors: ArrayLike, covariances: ArrayLike) -> Float64:
    """Normalised squared errors xi^T C^-1 xi (N,) of ``errors`` (N, d), covariances (N, d, d).

    Raises:
        InputError: shapes that do not fit, or a singular covariance.
    """
    xi, C = as_numbers(errors, "errors"), as_numbers(covariances, "covariances")
    if xi.ndim != 2 or C.shape != (*xi.shape, xi.shape[1]):
        raise InputError(f"errors (N, d) and covariances (N, d, d), got {xi.shape} and {C.shape}")
    try:
        solved = np.linalg.solve(C, xi[..., None])[..., 0]
    except np.linalg.LinAlgError:
        raise InputError("a covariance is singular") from None
    return np.asarray((xi * solved).sum(axis=1))


def nees_limits(shares: ArrayLike, dimensions: int = 6) -> Float64:
    """Limits below which these shares of the NEES lie if the covariances are right."""
    from scipy.stats import chi2

    return np.asarray(chi2.ppf(shares, dimensions))


def covariance_coverage(
    squared: Float64, factor: float = 1.0, dimensions: int = 6
) -> dict[str, float]:
    """Shares of NEES (N,) within the ellipsoids of ``COVERAGES``; NaN without any.

    ``factor`` multiplies the covariances.
    """
    limits = factor * nees_limits(list(COVERAGES.values()), dimensions)
    shares = [float((squared < limit).mean()) if len(squared) else np.nan for limit in limits]
    return dict(zip(COVERAGES, shares, strict=True))


def silently_wrong(
    estimate: ArrayLike,
    truth: ArrayLike,
    covariances: ArrayLike,
    distance_m: float = SILENT_M,
    sigmas: float = SILENT_SIGMAS,
) -> NDArray[np.bool_]:
    """Which positions (N,) are wrong by more than a distance and more than they admit.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise, corresponding by row.
        covariances: (N, 6, 6) of the poses' twists; see `pose_twists`.
        distance_m: error that does no harm.
        sigmas: error that a covariance explains, in standard deviations of the position, the root
            of the sum over its axes.

    Raises:
        InputError: wrong shapes, lengths that differ, NaN in poses.
    """
    poses, true_poses, C = _checked(estimate, truth, covariances)
    errors = np.linalg.norm(poses[:, :3, 3] - true_poses[:, :3, 3], axis=1)
    deviations = np.sqrt(np.trace(C[:, :3, :3], axis1=1, axis2=2))
    return (errors > distance_m) & (errors > sigmas * deviations)
