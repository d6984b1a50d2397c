"""Camera poses from map points and their observed positions in the image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, make_pose, orthonormal, transform_points
from ms_slam_env.slam.shared.rows import Rows

# 95 % quantiles of the chi-squared distribution with two and three degrees of freedom.
CHI2_PIXEL, CHI2_PIXEL_AND_DEPTH = 5.991, 7.815
_ITERATIONS = 4  # per round; outliers are reclassified between rounds
_SMALL_STEP = 1e-4  # metres and radians
_LEAST_DEPTH_M = 0.05
_FEWEST = 6  # least number of sightings for a pose
_DAMPING = 1e-9 * np.eye(6)
_RANSAC_ITERATIONS = 200


@dataclass(frozen=True)
class Sightings(Rows):
    """Observed positions of points in an image."""

    pixels: Float64  # (N, 2) measured positions
    inverse_depth: Float64  # (N,) measured, 1/m; 0 = not known
    sigma_px: Float64  # (N,) standard deviation of the positions, pixels
    sigma_inverse_depth: float  # standard deviation of the inverse depth, 1/m


def residuals(
    T_camera_world: Float64, points: Float64, seen: Sightings, intrinsics: Intrinsics
) -> tuple[Float64, Float64]:
    """Residuals (N, 3) of u, v and inverse depth in standard deviations, and points (N, 3).

    The returned points are in the camera frame; one behind the camera has infinite residuals. An
    unmeasured depth has residual 0.
    """
    p = transform_points(T_camera_world, points)
    return weighted_residuals(p, seen, intrinsics), p


def weighted_residuals(p: Float64, seen: Sightings, intrinsics: Intrinsics) -> Float64:
    """Residuals (N, 3) of points ``p`` (N, 3) in the camera frame; see ``residuals``."""
    z = np.maximum(p[:, 2], _LEAST_DEPTH_M)
    r = np.empty((len(p), 3))
    r[:, 0] = (intrinsics.fx * p[:, 0] / z + intrinsics.cx - seen.pixels[:, 0]) / seen.sigma_px
    r[:, 1] = (intrinsics.fy * p[:, 1] / z + intrinsics.cy - seen.pixels[:, 1]) / seen.sigma_px
    r[:, 2] = (1.0 / z - seen.inverse_depth) / seen.sigma_inverse_depth
    r[seen.inverse_depth == 0, 2] = 0.0
    r[p[:, 2] < _LEAST_DEPTH_M] = np.inf
    return r


def residual_jacobian(p: Float64, seen: Sightings, intrinsics: Intrinsics) -> Float64:
    """Derivatives (N, 3, 3) of ``weighted_residuals`` with respect to ``p``."""
    x, y = p[:, 0], p[:, 1]
    z = np.maximum(p[:, 2], _LEAST_DEPTH_M)
    J = np.zeros((len(p), 3, 3))
    a, b = intrinsics.fx / (z * seen.sigma_px), intrinsics.fy / (z * seen.sigma_px)
    J[:, 0, 0], J[:, 0, 2] = a, -a * x / z
    J[:, 1, 1], J[:, 1, 2] = b, -b * y / z
    measured = seen.inverse_depth > 0
    J[:, 2, 2] = np.where(measured, -1.0 / (z**2 * seen.sigma_inverse_depth), 0.0)
    return J


def refine_pose(
    T_world_camera: Float64,
    points: Float64,
    seen: Sightings,
    intrinsics: Intrinsics,
    rounds: int = 3,
) -> tuple[Float64, NDArray[np.bool_]]:
    """Find the pose that best explains the sightings, and which of them (N,) it explains.

    Gauss-Newton with Huber weights; between rounds outliers are removed by the 95 % quantile of
    chi-squared, as in ORB-SLAM2 (Mur-Artal and Tardos, TRO 2017, section III-C). Here the third
    measurement is inverse depth.

    Args:
        T_world_camera: (4, 4) initial pose.
        points: (N, 3) world frame.
        seen: their observations in the frame.
        intrinsics: intrinsics of the frame.
        rounds: rounds of iterations.
    """
    limit = np.where(seen.inverse_depth > 0, CHI2_PIXEL_AND_DEPTH, CHI2_PIXEL)
    T = invert(T_world_camera)
    inlier = np.ones(len(points), dtype=bool)
    for _ in range(rounds):
        inlier &= points @ T[2, :3] + T[2, 3] > _LEAST_DEPTH_M
        if inlier.sum() < _FEWEST:
            break
        used = np.flatnonzero(inlier)
        T = _gauss_newton(T, points[used], seen.chosen(used), limit[used], intrinsics)
        squares = (residuals(T, points, seen, intrinsics)[0] ** 2).sum(axis=1)
        inlier = squares <= limit
    return orthonormal(invert(T)), inlier


def sighting_covariance(
    T_world_camera: Float64, points: Float64, seen: Sightings, intrinsics: Intrinsics
) -> Float64:
    """Covariance (6, 6) of a pose that explains sightings, of the twist T_world_camera exp(xi)."""
    p = transform_points(invert(T_world_camera), points)
    A = _pose_jacobian(residual_jacobian(p, seen, intrinsics), p)
    return np.asarray(np.linalg.inv(A.T @ A + _DAMPING), dtype=np.float64)


def _pose_jacobian(by_point: Float64, p: Float64) -> Float64:
    """Derivatives (3N, 6) with respect to a twist of the camera; ``by_point`` (N, 3, 3) and ``p``.

    d(p) / d(phi) = -hat(p)
    """
    x, y, z = p.T[:, :, None]
    J = np.empty((len(p), 3, 6))
    J[:, :, :3] = by_point
    J[:, :, 3] = J[:, :, 2] * y - J[:, :, 1] * z
    J[:, :, 4] = J[:, :, 0] * z - J[:, :, 2] * x
    J[:, :, 5] = J[:, :, 1] * x - J[:, :, 0] * y
    return J.reshape(-1, 6)


def _gauss_newton(
    T: Float64, points: Float64, seen: Sightings, limit: Float64, intrinsics: Intrinsics
) -> Float64:
    """Refine ``T`` in a few steps; return T_camera_world (4, 4)."""
    for _ in range(_ITERATIONS):
        r, p = residuals(T, points, seen, intrinsics)
        if not np.isfinite(r).all():
            break
        squares = np.einsum("nk,nk->n", r, r)
        weight = np.sqrt(np.minimum(1.0, np.sqrt(limit / np.maximum(squares, 1e-12))))
        A = _pose_jacobian(residual_jacobian(p, seen, intrinsics) * weight[:, None, None], p)
        H = A.T @ A + _DAMPING
        step = np.linalg.solve(H, -A.T @ (r * weight[:, None]).ravel())
        T = make_pose(cv2.Rodrigues(step[3:])[0], step[:3]) @ T
        if np.abs(step).max() < _SMALL_STEP:
            break
    return T


def pose_from_matches(
    points: Float64, pixels: Float64, intrinsics: Intrinsics, error_px: float
) -> tuple[Float64, NDArray[np.bool_]] | None:
    """Estimate T_points_camera (4, 4) and its inliers (N,) by PnP and RANSAC; None on failure.

    Deterministic: OpenCV's RANSAC uses the same random seed in every call.
    """
    if len(points) < 6:
        return None
    found, turn, shift, kept = cv2.solvePnPRansac(
        points,
        pixels,
        intrinsics.matrix,
        None,
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=error_px,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or kept is None or not np.isfinite(turn).all():
        return None
    inlier = np.zeros(len(points), dtype=bool)
    inlier[kept.ravel()] = True
    return invert(make_pose(cv2.Rodrigues(turn)[0], shift.ravel())), inlier
