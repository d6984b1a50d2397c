"""Local bundle adjustment around a keyframe."""

from __future__ import annotations

import numpy as np

from ms_slam_env.geometry import invert
from ms_slam_env.slam.sparse.bundle_adjustment import Bundle, adjust_bundle
from ms_slam_env.slam.sparse.config import SparseConfig
from ms_slam_env.slam.sparse.matching import Int64
from ms_slam_env.slam.sparse.pose import (
    CHI2_PIXEL,
    CHI2_PIXEL_AND_DEPTH,
    Sightings,
    residuals,
)
from ms_slam_env.slam.sparse.sparse_map import SparseMap

_MOST_FIXED = 6  # keyframes beyond the window that hold it in place


def adjust_around(sparse_map: SparseMap, keyframe: int, config: SparseConfig) -> None:
    """Adjust a keyframe, those that share most points with it, and the points that they see.

    Other keyframes that see these points hold them in place. Sightings that do not fit
    afterwards are forgotten.
    """
    window = [keyframe, *sparse_map.neighbours(keyframe, config.window - 1)]
    point_ids = sparse_map.points_of(window)
    others = [k for k in range(len(sparse_map.keyframes)) if k not in window]
    counts = sparse_map.shared(point_ids, others)
    order = np.argsort(-counts, kind="stable")[:_MOST_FIXED]
    anchors = [others[n] for n in order if counts[n] > 0]
    fixed = [sparse_map.keyframes[k].known for k in window] + [True] * len(anchors)
    if all(fixed[: len(window)]):
        return
    if not any(fixed):
        fixed[window.index(min(window))] = True
    keyframes = window + anchors
    camera, feature, ids = _sightings(sparse_map, keyframes, point_ids)
    if len(ids) == 0:
        return
    used, point = np.unique(ids, return_inverse=True)
    bundle = Bundle(
        poses=np.stack([sparse_map.keyframes[k].T_world_camera for k in keyframes]),
        fixed=np.array(fixed),
        points=sparse_map.positions[used],
        camera=camera,
        point=point,
        seen=_gather(sparse_map, keyframes, camera, feature, config),
    )
    poses, points = adjust_bundle(bundle, sparse_map.intrinsics)
    for k, pose in zip(keyframes, poses, strict=True):
        sparse_map.keyframes[k].T_world_camera = pose
    sparse_map.positions[used] = points
    _forget_outliers(sparse_map, keyframes, bundle, feature, points)


def _sightings(
    sparse_map: SparseMap, keyframes: list[int], point_ids: Int64
) -> tuple[Int64, Int64, Int64]:
    """Keyframe (by place), feature and point of every sighting of points seen twice or more."""
    wanted = np.zeros(len(sparse_map.positions) + 1, dtype=bool)  # the last is "none", -1
    wanted[point_ids] = True
    features = [np.flatnonzero(wanted[sparse_map.keyframes[k].point_ids]) for k in keyframes]
    camera = np.repeat(np.arange(len(keyframes)), [len(f) for f in features])
    feature = np.concatenate(features)
    ids = np.concatenate(
        [sparse_map.keyframes[k].point_ids[f] for k, f in zip(keyframes, features, strict=True)]
    )
    often = np.bincount(ids, minlength=1)[ids] >= 2 if len(ids) else np.zeros(0, dtype=bool)
    return camera[often], feature[often], ids[often]


def _gather(
    sparse_map: SparseMap,
    keyframes: list[int],
    camera: Int64,
    feature: Int64,
    config: SparseConfig,
) -> Sightings:
    """The measurements of sightings."""
    pixels = np.empty((len(camera), 2))
    inverse_depth, scale = np.empty(len(camera)), np.empty(len(camera))
    for place, k in enumerate(keyframes):
        here = camera == place
        features = sparse_map.keyframes[k].features
        pixels[here] = features.pixels[feature[here]]
        inverse_depth[here] = features.inverse_depth[feature[here]]
        scale[here] = features.scale[feature[here]]
    sigma = config.pixel_noise * scale
    return Sightings(pixels, inverse_depth, sigma, config.inverse_depth_noise)


def _forget_outliers(
    sparse_map: SparseMap, keyframes: list[int], bundle: Bundle, feature: Int64, points: np.ndarray
) -> None:
    seen = bundle.seen
    for place, k in enumerate(keyframes):
        here = np.flatnonzero(bundle.camera == place)
        keyframe = sparse_map.keyframes[k]
        these = Sightings(
            seen.pixels[here],
            seen.inverse_depth[here],
            seen.sigma_px[here],
            seen.sigma_inverse_depth,
        )
        r, _ = residuals(
            invert(keyframe.T_world_camera),
            points[bundle.point[here]],
            these,
            sparse_map.intrinsics,
        )
        limit = np.where(these.inverse_depth > 0, CHI2_PIXEL_AND_DEPTH, CHI2_PIXEL)
        bad = (r**2).sum(axis=1) > 2 * limit  # twice: what the next adjustment may still mend
        keyframe.point_ids[feature[here[bad]]] = -1
