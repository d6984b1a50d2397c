"""Localises a frame in the map, near a known pose or by matching it with a keyframe."""

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

_LEAST_OVERLAP = 0.3  # share of a frame's readings that its reference keyframe must show
_LEAST_INLIERS, _LEAST_ALIKE = 0.75, 0.8  # shares that must fit its depth and its intensity
_SAME_PX = 1.0  # corners closer than this to a point's position show that point
_RADIUS = 0.045  # search radius around a projected point, share of the image's width
_NEIGHBOURS = 6  # keyframes, besides the reference, whose points are searched for
_RANSAC_SIGMAS = 3.0
_SIGMA_STEP_PX = 0.1
_CORNER_SHIFT_PX = 1.5  # largest correction of a corner
_SAMPLES = 1000  # readings used to verify a pose
_LEAST_EXPLAINED = 0.25  # share of the matches that the pose must explain
_PATCH_SHIFT_PX = 3.0  # largest distance of a patch from where its point projects to


@dataclass(frozen=True)
class LiveFrame:
    """A frame to be localised."""

    image: DepthImage  # its depth and intensity
    inverse_depth: InverseDepth  # its inverse depth with subpixel lookup
    features: Features  # its features
    tree: cKDTree | None  # k-d tree of the features' pixels; None if there are none

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
    """A pose with its supporting matches."""

    T_world_camera: Float64  # (4, 4) pose
    reference: int  # the keyframe that shares most of its points
    point_ids: Int64  # (M,) points that the frame shows where the pose predicts them
    features: Int64  # (M,) features of the frame that show them; -1 where a patch does
    seen: Sightings  # their subpixel positions in the frame
    matches: int  # number of matches, M of which the pose explains
    visible: Int64  # (V,) points that should be in the image


class Localizer:
    """Localises frames in a map."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map
        self._intrinsics: Intrinsics = sparse_map.intrinsics
        self._thresholds = AcceptanceThresholds(  # a keyframe may be anywhere that sees the same
            overlap=_LEAST_OVERLAP,
            inlier_ratio=_LEAST_INLIERS,
            photometric_inlier_ratio=_LEAST_ALIKE,
        )

    def near(self, frame: LiveFrame, T_world_camera: Float64, reference: int) -> Fix | None:
        """Localise a frame near a pose that sees what the reference keyframe sees.

        Points are matched with features near their projections, and then refined to subpixel
        accuracy with patches of the keyframe.
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
        """Match candidate points with features near their projections."""
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
        """Estimate a frame's pose from its matches with a keyframe, without an initial guess."""
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
        """Verify a pose by its matches, and by depth and intensity of its reference keyframe."""
        explained = len(fix.point_ids)
        reason, refusal, found = "", "", NO_ALIGNMENT
        if explained < LEAST_MATCHES:
            reason = f"only {explained} corners match the map, of {LEAST_MATCHES} needed"
        elif explained < _LEAST_EXPLAINED * fix.matches:
            reason = f"only {explained} of {fix.matches} matching corners fit one pose"
        else:
            keyframe = self._map.keyframes[fix.reference]
            motion = invert(keyframe.T_world_camera) @ fix.T_world_camera
            images, rule = (frame.image, keyframe.image()), (self._thresholds, _SAMPLES)
            found, reason, refusal = check_alignment(*images, motion, self._intrinsics, *rule)
        return Attempt(fix.T_world_camera, found, reason, fix, refusal)

    def _sightings(self, features: Features, which: Int64) -> Sightings:
        """Measurements of the selected features."""
        return Sightings(
            features.pixels[which],
            features.inverse_depth[which],
            PIXEL_NOISE * features.scale[which],
            INVERSE_DEPTH_NOISE,
        )

    def _project(self, point_ids: Int64, T_world_camera: Float64) -> tuple[Int64, Float64]:
        """Project points; return the ids of those in the image and their pixels (V, 2)."""
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
        """Combine matches and patches: points, features (-1 for a patch) and sightings."""
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
        # Rounded up: bundle adjustment keeps one noise model per value.
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
        """Patches of points in the keyframes that created them."""
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
    """Features of a new keyframe, and the point id (N,) that each shows, or -1.

    Tracked points come first, at their measured positions; corners next to them are left out.
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
