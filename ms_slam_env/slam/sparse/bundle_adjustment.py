"""Bundle adjustment through GTSAM: poses and points that explain the sightings best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.sparse.gtsam_library import load_gtsam
from ms_slam_env.slam.sparse.matching import Int64
from ms_slam_env.slam.sparse.pose import (
    CHI2_PIXEL,
    CHI2_PIXEL_AND_DEPTH,
    Sightings,
    orthonormal,
)

_BASELINE_M = 0.1  # of the imagined second camera; the result does not depend on it
_FIXED_SIGMA = 1e-6  # of a pose that stays where it is, metres and radians
_ITERATIONS = 3
_ERROR_TOLERANCE = 1e-3  # a smaller relative gain ends the iterations


@dataclass(frozen=True)
class Bundle:
    """Keyframes, points and sightings.

    Attributes:
        poses: (K, 4, 4) T_world_camera.
        fixed: (K,) bool, poses that stay.
        points: (P, 3) world frame.
        camera: (O,) pose of each sighting.
        point: (O,) point of each sighting.
        seen: O sightings.
    """

    poses: Float64
    fixed: NDArray[np.bool_]
    points: Float64
    camera: Int64
    point: Int64
    seen: Sightings


def adjust_bundle(bundle: Bundle, intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Poses (K, 4, 4) and points (P, 3) of least squares, with Huber's loss.

    Depth enters as the disparity of an imagined second camera, as in ORB-SLAM2 (section III-C);
    the errors of the two images are correlated so that pixel and inverse depth are independent.

    Raises:
        InputError: GTSAM is not installed.
    """
    gtsam = load_gtsam()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first_point = len(bundle.poses)
    stay = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    for index, (pose, fixed) in enumerate(zip(bundle.poses, bundle.fixed, strict=True)):
        value = gtsam.Pose3(pose)
        values.insert(index, value)
        if fixed:
            graph.add(gtsam.PriorFactorPose3(index, value, stay))
    for index, point in enumerate(bundle.points):
        values.insert(first_point + index, point)
    for factor in _sighting_factors(gtsam, bundle, intrinsics, first_point):
        graph.add(factor)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(_ERROR_TOLERANCE)
    parameters.setlambdaInitial(1e-4)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    poses = bundle.poses.copy()
    for free in np.flatnonzero(~bundle.fixed).tolist():
        poses[free] = orthonormal(result.atPose3(free).matrix())
    points = [result.atPoint3(first_point + index) for index in range(len(bundle.points))]
    return poses, np.array(points).reshape(-1, 3)


def _sighting_factors(
    gtsam: Any, bundle: Bundle, intrinsics: Intrinsics, first_point: int
) -> list[Any]:
    """One factor per sighting: with depth that of a stereo camera, without that of one camera."""
    i = intrinsics
    stereo = gtsam.Cal3_S2Stereo(i.fx, i.fy, 0.0, i.cx, i.cy, _BASELINE_M)
    single = gtsam.Cal3_S2(i.fx, i.fy, 0.0, i.cx, i.cy)
    seen = bundle.seen
    disparity = i.fx * _BASELINE_M * seen.inverse_depth
    sigma_disparity = i.fx * _BASELINE_M * seen.sigma_inverse_depth
    has_depth = seen.inverse_depth > 0
    noises: dict[tuple[float, bool], Any] = {}
    for sigma in np.unique(seen.sigma_px):
        noises[sigma, True] = _robust(gtsam, _stereo_covariance(sigma, sigma_disparity))
        noises[sigma, False] = _robust(gtsam, sigma**2 * np.eye(2))
    factors = []
    rows = zip(
        bundle.camera.tolist(),
        (first_point + bundle.point).tolist(),
        seen.pixels.tolist(),
        disparity.tolist(),
        has_depth.tolist(),
        seen.sigma_px.tolist(),
        strict=True,
    )
    for camera, point, (u, v), shift, deep, sigma in rows:
        noise = noises[sigma, deep]
        if deep:
            at = gtsam.StereoPoint2(u, u - shift, v)
            factor = gtsam.GenericStereoFactor3D(at, noise, camera, point, stereo, False, False)
        else:
            pixel = np.array([u, v])
            factor = gtsam.GenericProjectionFactorCal3_S2(
                pixel, noise, camera, point, single, False, False
            )
        factors.append(factor)
    return factors


def _stereo_covariance(sigma_px: float, sigma_disparity: float) -> Float64:
    """Covariance (3, 3) of (left u, right u, v), the right one being left minus disparity."""
    pixel = sigma_px**2
    return np.array(
        [[pixel, pixel, 0.0], [pixel, pixel + sigma_disparity**2, 0.0], [0.0, 0.0, pixel]]
    )


def _robust(gtsam: Any, covariance: Float64) -> Any:
    limit = CHI2_PIXEL if len(covariance) == 2 else CHI2_PIXEL_AND_DEPTH
    huber = gtsam.noiseModel.mEstimator.Huber.Create(float(np.sqrt(limit)))
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(covariance))
