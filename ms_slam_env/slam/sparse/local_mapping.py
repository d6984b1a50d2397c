"""Local bundle adjustment around a keyframe, with GTSAM."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, orthonormal
from ms_slam_env.slam.shared.point_poses import (
    CHI2_PIXEL,
    CHI2_PIXEL_AND_DEPTH,
    Sightings,
    residuals,
)
from ms_slam_env.slam.sparse.sparse_config import INVERSE_DEPTH_NOISE, PIXEL_NOISE
from ms_slam_env.slam.sparse.sparse_map import SparseMap

_BASELINE_M = 0.1  # of a virtual second camera; does not affect the result
_FIXED_SIGMA = 1e-6  # of a fixed pose, metres and radians
_ITERATIONS = 3
_ERROR_TOLERANCE = 1e-3  # iterations end at a smaller relative improvement
_MOST_FIXED = 3  # keyframes beyond the window that hold it in place


def load_gtsam() -> Any:
    """Import GTSAM.

    Raises:
        InputError: it is not installed.
    """
    try:
        import gtsam
    except (ImportError, OSError) as error:
        raise InputError(
            f"the sparse backend needs GTSAM (pip install 'ms-slam-env[gtsam]'): {error}"
        ) from error
    return gtsam


@dataclass(frozen=True)
class Bundle:
    """Keyframes, points and sightings."""

    poses: Float64  # (K, 4, 4) T_world_camera
    fixed: NDArray[np.bool_]  # (K,) bool, poses that are held fixed
    points: Float64  # (P, 3) world frame
    camera: Int64  # (O,) pose of each sighting
    point: Int64  # (O,) point of each sighting
    seen: Sightings  # O sightings


def adjust_bundle(bundle: Bundle, intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Least-squares poses (K, 4, 4) and points (P, 3), with Huber loss.

    Depth enters as the disparity of a virtual second camera, as in ORB-SLAM2 (section III-C); the
    errors of the two images are correlated so that pixel and inverse depth are independent.
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
    """One factor per sighting: stereo if its depth is known, otherwise monocular."""
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
    """Covariance (3, 3) of (left u, right u, v), where right u is left u minus disparity."""
    pixel = sigma_px**2
    return np.array(
        [[pixel, pixel, 0.0], [pixel, pixel + sigma_disparity**2, 0.0], [0.0, 0.0, pixel]]
    )


def _robust(gtsam: Any, covariance: Float64) -> Any:
    limit = CHI2_PIXEL if len(covariance) == 2 else CHI2_PIXEL_AND_DEPTH
    huber = gtsam.noiseModel.mEstimator.Huber.Create(float(np.sqrt(limit)))
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(covariance))


def adjust_around(sparse_map: SparseMap, keyframe: int, size: int) -> None:
    """Adjust the ``size`` keyframes that share most points with one, and the points they see.

    Other keyframes that see these points stay fixed as anchors. Sightings that do not fit
    afterwards are removed.
    """
    window, anchors = _choose_keyframes(sparse_map, keyframe, size)
    keyframes = window + anchors
    fixed = np.array([sparse_map.keyframes[k].known for k in window] + [True] * len(anchors))
    if not fixed.any():
        fixed[window.index(min(window))] = True
    bundle, feature, ids = _gather(sparse_map, keyframes, fixed, sparse_map.points_of(window))
    if len(feature) == 0:
        return
    poses, points = adjust_bundle(bundle, sparse_map.intrinsics)
    for k, pose in zip(window, poses, strict=False):
        sparse_map.keyframes[k].T_world_camera = pose
    sparse_map.positions[ids] = points
    _forget_outliers(sparse_map, keyframes, replace(bundle, points=points), feature)


def _choose_keyframes(
    sparse_map: SparseMap, keyframe: int, size: int
) -> tuple[list[int], list[int]]:
    """Select keyframes to adjust, and others to hold them in place."""
    window = [keyframe, *sparse_map.neighbours(keyframe, size - 1)]
    others = [k for k in range(len(sparse_map.keyframes)) if k not in window]
    counts = sparse_map.shared(sparse_map.points_of(window), others)
    order = np.argsort(-counts, kind="stable")[:_MOST_FIXED]
    return window, [others[n] for n in order if counts[n] > 0]


def _gather(
    sparse_map: SparseMap,
    keyframes: list[int],
    fixed: NDArray[np.bool_],
    point_ids: Int64,
) -> tuple[Bundle, Int64, Int64]:
    """A bundle of the points seen at least twice, each sighting's feature, and the point ids."""
    frames = [sparse_map.keyframes[k] for k in keyframes]
    wanted = np.zeros(len(sparse_map.positions) + 1, dtype=bool)  # the last is "none", -1
    wanted[point_ids] = True
    features = [np.flatnonzero(wanted[frame.point_ids]) for frame in frames]
    pairs = list(zip(frames, features, strict=True))
    ids = np.concatenate([frame.point_ids[f] for frame, f in pairs])
    often = np.bincount(ids, minlength=1)[ids] >= 2 if len(ids) else ids.astype(bool)
    camera = np.repeat(np.arange(len(frames)), [len(f) for f in features])[often]
    scale = np.concatenate([frame.features.scale[f] for frame, f in pairs])[often]
    used, point = np.unique(ids[often], return_inverse=True)
    seen = Sightings(
        np.concatenate([frame.features.pixels[f] for frame, f in pairs])[often],
        np.concatenate([frame.features.inverse_depth[f] for frame, f in pairs])[often],
        PIXEL_NOISE * scale,
        INVERSE_DEPTH_NOISE,
    )
    poses = np.stack([frame.T_world_camera for frame in frames])
    bundle = Bundle(poses, fixed, sparse_map.positions[used], camera, point, seen)
    return bundle, np.concatenate(features)[often], used


def _forget_outliers(
    sparse_map: SparseMap, keyframes: list[int], bundle: Bundle, feature: Int64
) -> None:
    """Detach features from points that they do not show."""
    for place, k in enumerate(keyframes):
        here = np.flatnonzero(bundle.camera == place)
        keyframe, seen = sparse_map.keyframes[k], bundle.seen.chosen(here)
        points: Float64 = bundle.points[bundle.point[here]]
        r, _ = residuals(invert(keyframe.T_world_camera), points, seen, sparse_map.intrinsics)
        limit = np.where(seen.inverse_depth > 0, CHI2_PIXEL_AND_DEPTH, CHI2_PIXEL)
        bad = (r**2).sum(axis=1) > 2 * limit  # twice: the next adjustment may fix them
        keyframe.point_ids[feature[here[bad]]] = -1
