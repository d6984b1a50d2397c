"""Finds the pose of a frame in the map: near a pose, or by the looks of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.slam.shared.alignment_check import NO_ALIGNMENT, AcceptanceThresholds
from ms_slam_env.slam.shared.alignment_measures import DepthImage, check_alignment
from ms_slam_env.slam.shared.feature_matching import match_anywhere, match_near
from ms_slam_env.slam.shared.orb_features import Features, InverseDepth
from ms_slam_env.slam.shared.point_poses import Sightings, pose_from_matches, refine_pose
from ms_slam_env.slam.shared.rows import join
from ms_slam_env.slam.shared.tracking_template import Attempt
from ms_slam_env.slam.sparse.patches import Patches, Templates, find_patches
from ms_slam_env.slam.sparse.sparse_config import (
    HAMMING,
    INVERSE_DEPTH_NOISE,
    LEAST_MATCHES,
    PIXEL_NOISE,
)
from ms_slam_env.slam.sparse.sparse_map import SparseMap

_LEAST_OVERLAP = 0.3  # share of a frame's readings that the keyframe beside it must show
_LEAST_INLIERS, _LEAST_ALIKE = 0.75, 0.8  # shares of those that must fit its depth, its intensity
_SAME_PX = 1.0  # corners closer than this to a point's place are that point
_RADIUS = 0.045  # of the search for a point, share of the image's width
_NEIGHBOURS = 6  # keyframes, besides the reference, whose points are looked for
_RANSAC_SIGMAS = 3.0
_SIGMA_STEP_PX = 0.1
_CORNER_SHIFT_PX = 1.5  # largest correction of a corner
_SAMPLES = 1000  # readings that a pose is judged by
_LEAST_EXPLAINED = 0.25  # share of the matches
_PATCH_SHIFT_PX = 3.0  # largest distance of a patch from where its point projects to


@dataclass(frozen=True)
class LiveFrame:
    """A frame that is to be placed."""

    image: DepthImage  # its depth and intensity
    inverse_depth: InverseDepth  # its depth for points between pixels
    features: Features  # its features
    tree: cKDTree | None  # of the features' pixels; None if there are none

    @property
    def readings(self) -> float:
        """Share of the pixels that have depth."""
        return self.image.readings

    def showing(self, features: Features) -> LiveFrame:
        """The same frame with other features."""
        tree = cKDTree(features.pixels) if len(features) else None
        return replace(self, features=features, tree=tree)


@dataclass(frozen=True)
class Fix:
    """A pose and what speaks for it."""

    T_world_camera: Float64  # (4, 4) pose
    reference: int  # the keyframe that shares most of its points
    point_ids: Int64  # (M,) points that the frame shows where the pose has them
    features: Int64  # (M,) features of the frame that show them; -1 where a patch does
    seen: Sightings  # where the frame shows them, to a fraction of a pixel
    matches: int  # how many matches there were, M of which the pose explains
    visible: Int64  # (V,) points that should be in the image


class Localizer:
    """Places frames in a map."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map
        self._intrinsics: Intrinsics = sparse_map.intrinsics
        self._thresholds = AcceptanceThresholds(  # a keyframe may be anywhere that sees the same
            overlap=_LEAST_OVERLAP,
            inlier_ratio=_LEAST_INLIERS,
            photometric_inlier_ratio=_LEAST_ALIKE,
        )

    def near(self, frame: LiveFrame, T_world_camera: Float64, reference: int) -> Fix | None:
        """Place a frame that is near a pose and sees what the reference keyframe sees.

        The points are sought among the features near where they project to; then as patches of
        the keyframe, to a fraction of a pixel.
        """
        keyframes = [reference, *self._map.neighbours(reference, _NEIGHBOURS)]
        candidates = self._map.points_of(keyframes)
        T = T_world_camera
        ids, features = self._match(frame, candidates, T)
        if len(ids) >= LEAST_MATCHES:
            seen = self._sightings(frame.features, features)
            T, inlier = refine_pose(T, self._map.positions[ids], seen, self._intrinsics)
            ids, features = ids[inlier], features[inlier]
            counts = self._map.shared(ids, keyframes)
            reference = keyframes[int(counts.argmax())]
        visible, projected = self._project(candidates, T)
        ids, features, seen = self._register(frame, T, visible, projected, ids, features)
        if len(ids) < LEAST_MATCHES:
            return None
        T, inlier = refine_pose(T, self._map.positions[ids], seen, self._intrinsics)
        return Fix(
            T, reference, ids[inlier], features[inlier], seen.chosen(inlier), len(ids), visible
        )

    def _match(
        self, frame: LiveFrame, candidates: Int64, T_world_camera: Float64
    ) -> tuple[Int64, Int64]:
        """Points, of the candidates, and features that match near where they project to."""
        visible, projected = self._project(candidates, T_world_camera)
        if frame.tree is None or len(visible) == 0:
            return visible[:0], visible[:0]
        points, features = match_near(
            projected,
            self._map.descriptors[visible],
            frame.tree,
            frame.features.descriptors,
            _RADIUS * self._intrinsics.width,
            HAMMING,
        )
        return visible[points], features

    def by_looks(self, frame: LiveFrame, keyframe: int) -> Float64 | None:
        """A pose of a frame that shows what a keyframe shows, wherever that was."""
        other = self._map.keyframes[keyframe]
        theirs = np.flatnonzero(other.point_ids >= 0)
        a, b = match_anywhere(
            other.features.descriptors[theirs], frame.features.descriptors, HAMMING
        )
        if len(a) < LEAST_MATCHES:
            return None
        points = self._map.positions[other.point_ids[theirs[a]]]
        error_px = _RANSAC_SIGMAS * PIXEL_NOISE * 1.5
        found = pose_from_matches(points, frame.features.pixels[b], self._intrinsics, error_px)
        if found is None or found[1].sum() < LEAST_MATCHES * 2 // 3:
            return None
        T, inlier = found
        seen = self._sightings(frame.features, b[inlier])
        return refine_pose(T, points[inlier], seen, self._intrinsics)[0]

    def verify(self, fix: Fix, frame: LiveFrame) -> Attempt[Fix]:
        """Judge a pose by its matches, and by depth and intensity of the keyframe beside it."""
        explained = len(fix.point_ids)
        reason, found = "", NO_ALIGNMENT
        if explained < LEAST_MATCHES:
            reason = f"only {explained} corners match the map, of {LEAST_MATCHES} needed"
        elif explained < _LEAST_EXPLAINED * fix.matches:
            reason = f"only {explained} of {fix.matches} matching corners fit one pose"
        else:
            keyframe = self._map.keyframes[fix.reference]
            motion = invert(keyframe.T_world_camera) @ fix.T_world_camera
            images, rule = (frame.image, keyframe.image()), (self._thresholds, _SAMPLES)
            found, reason = check_alignment(*images, motion, self._intrinsics, *rule)
        return Attempt(fix.T_world_camera, found, reason, fix)

    def _sightings(self, features: Features, which: Int64) -> Sightings:
        """Measurements of some features."""
        return Sightings(
            features.pixels[which],
            features.inverse_depth[which],
            PIXEL_NOISE * features.scale[which],
            INVERSE_DEPTH_NOISE,
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

    def _register(
        self,
        frame: LiveFrame,
        T_world_camera: Float64,
        visible: Int64,
        projected: Float64,
        ids: Int64,
        features: Int64,
    ) -> tuple[Int64, Int64, Sightings]:
        """Points, features (-1 where there is none) and sightings, from matches and patches."""
        feature_of = np.full(len(self._map.positions), -1)
        feature_of[ids] = features
        matched = feature_of[visible] >= 0
        shift = np.zeros_like(projected)
        places = frame.features.pixels[feature_of[visible[matched]]]
        shift[matched] = places - projected[matched]
        patches, templates = self._patches(visible, shift, T_world_camera)
        image = frame.image.intensity
        pixels, sigma = find_patches(image, templates, patches, self._intrinsics)
        moved = np.abs(pixels - projected - shift).max(axis=1, initial=0)
        found = np.isfinite(sigma) & (moved < np.where(matched, _CORNER_SHIFT_PX, _PATCH_SHIFT_PX))
        sharp, pixels = visible[found], pixels[found]
        rest = ~np.isin(ids, sharp)
        other = self._sightings(frame.features, features[rest])
        # Rounded up: adjustment keeps one model of the noise for each value.
        sigma = np.ceil(sigma[found] / _SIGMA_STEP_PX) * _SIGMA_STEP_PX
        seen = Sightings(
            np.concatenate([pixels, other.pixels]),
            np.concatenate([frame.inverse_depth.at(pixels), other.inverse_depth]),
            np.concatenate([sigma, other.sigma_px]),
            INVERSE_DEPTH_NOISE,
        )
        all_ids = np.concatenate([sharp, ids[rest]])
        return all_ids, feature_of[all_ids], seen

    def _patches(
        self, ids: Int64, shift: Float64, T_world_camera: Float64
    ) -> tuple[Patches, Templates]:
        """The patches of points in the keyframes that made them."""
        T_camera_world = invert(T_world_camera)
        pixels, slope = np.empty((len(ids), 2)), np.empty((len(ids), 2))
        motion = np.empty((len(ids), 4, 4))
        inverse = np.empty(len(ids))
        templates = Templates.empty(len(ids))
        hosts = self._map.hosts[ids]
        for host in np.unique(hosts).tolist():
            here = np.flatnonzero(hosts == host)
            keyframe = self._map.keyframes[host]
            place = self._map.host_features[ids[here]]
            pixels[here] = keyframe.features.pixels[place]
            slope[here] = keyframe.slopes[place]
            templates.put(here, keyframe.templates.chosen(place))
            pose = keyframe.T_world_camera
            motion[here] = T_camera_world @ pose
            points = transform_points(invert(pose), self._map.positions[ids[here]])
            inverse[here] = 1.0 / np.maximum(points[:, 2], 0.05)
        return Patches(pixels, inverse, slope, motion, shift), templates


def keyframe_features(
    frame: LiveFrame, fix: Fix | None, sparse_map: SparseMap, pixel_noise: float
) -> tuple[Features, Int64]:
    """Features of a frame that becomes a keyframe, and the point (N,) that each shows or -1.

    Points that were found come first, where they were found; corners beside them are left out.
    """
    features = frame.features
    if fix is None:
        return features, np.full(len(features), -1, dtype=np.int64)
    taken = np.zeros(len(features), dtype=bool)
    taken[fix.features[fix.features >= 0]] = True
    if frame.tree is not None:
        for near in frame.tree.query_ball_point(fix.seen.pixels, _SAME_PX):
            taken[near] = True
    rest = features.chosen(~taken)
    descriptors = sparse_map.descriptors[fix.point_ids]
    own = fix.features >= 0
    descriptors[own] = features.descriptors[fix.features[own]]
    seen, scale = fix.seen, fix.seen.sigma_px / pixel_noise
    found = Features(seen.pixels, seen.inverse_depth, descriptors, scale)
    none = np.full(len(rest), -1, dtype=np.int64)
    return join([found, rest]), np.concatenate([fix.point_ids, none])
