"""Finds the pose of a frame in the map: near a pose, or by the looks of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.slam.agreement import DepthImage
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.sparse.config import SparseConfig
from ms_slam_env.slam.sparse.features import Features
from ms_slam_env.slam.sparse.matching import Int64, match_anywhere, match_near
from ms_slam_env.slam.sparse.pose import (
    Sightings,
    pose_from_matches,
    refine_pose,
)
from ms_slam_env.slam.sparse.sparse_map import SparseMap

_FAR, _NEAR = 0.045, 0.015  # search radii, shares of the image's width
_NEIGHBOURS = 6  # keyframes, besides the reference, whose points are looked for
_RANSAC_SIGMAS = 3.0
_SHARP_WINDOW = (9, 9)  # of the patches that are registered, pixels
_SHARP_SHIFT_PX = 1.5  # largest correction of a position
_SHARP_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.01)


@dataclass(frozen=True)
class LiveFrame:
    """A frame that is to be placed.

    Attributes:
        image: its depth and intensity.
        grey: (H, W) uint8.
        features: its features.
        tree: of the features' pixels; None if there are none.
    """

    image: DepthImage
    grey: NDArray[np.uint8]
    features: Features
    tree: cKDTree | None


@dataclass(frozen=True)
class Fix:
    """A pose and what speaks for it.

    Attributes:
        T_world_camera: (4, 4) pose.
        reference: the keyframe that shares most of its points.
        features: (M,) features of the frame that show points where the pose has them.
        point_ids: (M,) these points.
        pixels: (M, 2) where the features are, to a fraction of a pixel.
        matches: how many matches there were, M of which the pose explains.
        visible: (V,) points that should be in the image.
    """

    T_world_camera: Float64
    reference: int
    features: Int64
    point_ids: Int64
    pixels: Float64
    matches: int
    visible: Int64


class Localiser:
    """Places frames in a map.

    Args:
        sparse_map: keyframes and points.
        config: parameters.
    """

    def __init__(self, sparse_map: SparseMap, config: SparseConfig) -> None:
        self._map = sparse_map
        self._config = config
        self._intrinsics: Intrinsics = sparse_map.intrinsics

    def near(self, frame: LiveFrame, T_world_camera: Float64, reference: int) -> Fix | None:
        """Place a frame that is near a pose and sees what the reference keyframe sees.

        The points are sought where they project to, first in a wide circle, then in a narrow one.
        """
        if frame.tree is None:
            return None
        keyframes = [reference, *self._map.neighbours(reference, _NEIGHBOURS)]
        candidates = self._map.points_of(keyframes)
        T, sighted = T_world_camera, None
        for radius in (_FAR, _NEAR):
            visible, projected = self._project(candidates, T)
            point, feature = match_near(
                projected,
                self._map.descriptors[visible],
                frame.tree,
                frame.features.descriptors,
                radius * self._intrinsics.width,
                self._config.hamming,
            )
            if len(point) < self._config.least_matches:
                return None
            ids = visible[point]
            seen = self.sightings(frame.features, feature)
            sighted = (ids, feature, seen)
            T, inlier = refine_pose(T, self._map.positions[ids], seen, self._intrinsics, 2)
            if inlier.sum() < self._config.least_matches:
                return None
        assert sighted is not None
        ids, feature, seen = sighted
        counts = self._map.shared(ids[inlier], keyframes)
        reference = keyframes[int(counts.argmax())]
        seen = self._sharpen(frame, reference, ids, seen)
        T, inlier = refine_pose(T, self._map.positions[ids], seen, self._intrinsics, 2)
        return Fix(
            T, reference, feature[inlier], ids[inlier], seen.pixels[inlier], len(ids), visible
        )

    def by_looks(self, frame: LiveFrame, keyframe: int) -> Float64 | None:
        """A pose of a frame that shows what a keyframe shows, wherever that was."""
        other = self._map.keyframes[keyframe]
        theirs = np.flatnonzero(other.point_ids >= 0)
        a, b = match_anywhere(
            other.features.descriptors[theirs], frame.features.descriptors, self._config.hamming
        )
        if len(a) < self._config.least_matches:
            return None
        points = self._map.positions[other.point_ids[theirs[a]]]
        error_px = _RANSAC_SIGMAS * self._config.pixel_noise * 1.5
        found = pose_from_matches(points, frame.features.pixels[b], self._intrinsics, error_px)
        if found is None or found[1].sum() < self._config.least_matches * 2 // 3:
            return None
        T, inlier = found
        seen = self.sightings(frame.features, b[inlier])
        return refine_pose(T, points[inlier], seen, self._intrinsics)[0]

    def sightings(self, features: Features, which: Int64) -> Sightings:
        """Measurements of some features."""
        return Sightings(
            features.pixels[which],
            features.inverse_depth[which],
            self._config.pixel_noise * features.scale[which],
            self._config.inverse_depth_noise,
        )

    def _project(self, point_ids: Int64, T_world_camera: Float64) -> tuple[Int64, Float64]:
        """Those of the points that are in the image, and where (V, 2)."""
        points = transform_points(invert(T_world_camera), self._map.positions[point_ids])
        ahead = points[:, 2] > 0.1
        point_ids, points = point_ids[ahead], points[ahead]
        pixels = self._intrinsics.project(points)
        size = (self._intrinsics.width, self._intrinsics.height)
        inside = ((pixels > 0) & (pixels < np.array(size) - 1)).all(axis=1)
        return point_ids[inside], pixels[inside]

    def _sharpen(
        self, frame: LiveFrame, reference: int, point_ids: Int64, seen: Sightings
    ) -> Sightings:
        """Register patches with the reference keyframe: ORB's corners lie on whole pixels."""
        keyframe = self._map.keyframes[reference]
        place = np.full(len(self._map.positions), -1)
        theirs = np.flatnonzero(keyframe.point_ids >= 0)
        place[keyframe.point_ids[theirs]] = theirs
        here = np.flatnonzero(place[point_ids] >= 0)
        if len(here) == 0:
            return seen
        start = keyframe.features.pixels[place[point_ids[here]]].astype(np.float32)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            keyframe.grey,
            frame.grey,
            start,
            seen.pixels[here].astype(np.float32),
            winSize=_SHARP_WINDOW,
            maxLevel=0,
            criteria=_SHARP_CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        moved = moved.astype(np.float64)
        shift = np.abs(moved - seen.pixels[here]).max(axis=1)
        limit = _SHARP_SHIFT_PX * np.maximum(1.0, seen.sigma_px[here] / self._config.pixel_noise)
        good = (found.ravel() == 1) & (shift < limit)
        pixels = seen.pixels.copy()
        pixels[here[good]] = moved[good]
        return replace(seen, pixels=pixels)
