"""Local bundle adjustment around a keyframe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import invert
from ms_slam_env.slam.base import Float64
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

_MOST_FIXED = 3  # keyframes beyond the window that hold it in place


def adjust_around(sparse_map: SparseMap, keyframe: int, config: SparseConfig) -> None:
    """Adjust a keyframe, those that share most points with it, and the points that they see.

    Other keyframes that see these points hold them in place. Sightings that do not fit afterwards
    are forgotten.
    """
    window, anchors = _choose_keyframes(sparse_map, keyframe, config)
    keyframes = window + anchors
    fixed = np.array([sparse_map.keyframes[k].known for k in window] + [True] * len(anchors))
    if not fixed.any():
        fixed[window.index(min(window))] = True
    bundle, feature, ids = _gather(
        sparse_map, keyframes, fixed, sparse_map.points_of(window), config
    )
    if len(feature) == 0:
        return
    poses, points = adjust_bundle(bundle, sparse_map.intrinsics)
    for k, pose in zip(window, poses, strict=False):
        sparse_map.keyframes[k].T_world_camera = pose
    sparse_map.positions[ids] = points
    _forget_outliers(sparse_map, keyframes, replace(bundle, points=points), feature)


def _choose_keyframes(
    sparse_map: SparseMap, keyframe: int, config: SparseConfig
) -> tuple[list[int], list[int]]:
    """Keyframes that are adjusted, and others that hold them in place."""
    window = [keyframe, *sparse_map.neighbours(keyframe, config.window - 1)]
    others = [k for k in range(len(sparse_map.keyframes)) if k not in window]
    counts = sparse_map.shared(sparse_map.points_of(window), others)
    order = np.argsort(-counts, kind="stable")[:_MOST_FIXED]
    return window, [others[n] for n in order if counts[n] > 0]


def _gather(
    sparse_map: SparseMap,
    keyframes: list[int],
    fixed: NDArray[np.bool_],
    point_ids: Int64,
    config: SparseConfig,
) -> tuple[Bundle, Int64, Int64]:
    """The points seen twice or more, the feature of each sighting, and the ids of the points."""
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
        config.pixel_noise * scale,
        config.inverse_depth_noise,
    )
    poses = np.stack([frame.T_world_camera for frame in frames])
    bundle = Bundle(poses, fixed, sparse_map.positions[used], camera, point, seen)
    return bundle, np.concatenate(features)[often], used


def _forget_outliers(
    sparse_map: SparseMap, keyframes: list[int], bundle: Bundle, feature: Int64
) -> None:
    """Part features from points that they do not show."""
    for place, k in enumerate(keyframes):
        here = np.flatnonzero(bundle.camera == place)
        keyframe, seen = sparse_map.keyframes[k], bundle.seen.chosen(here)
        points: Float64 = bundle.points[bundle.point[here]]
        r, _ = residuals(invert(keyframe.T_world_camera), points, seen, sparse_map.intrinsics)
        limit = np.where(seen.inverse_depth > 0, CHI2_PIXEL_AND_DEPTH, CHI2_PIXEL)
        bad = (r**2).sum(axis=1) > 2 * limit  # twice: what the next adjustment may still mend
        keyframe.point_ids[feature[here[bad]]] = -1
