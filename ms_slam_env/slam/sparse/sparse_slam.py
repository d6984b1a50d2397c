"""Sparse SLAM with ORB features, as a ``SlamBackend``.

ORB-SLAM2 for RGB-D cameras (Mur-Artal and Tardos, TRO 2017, figure 2) without its threads: every
frame is matched with the points of the local map; keyframes add points, are adjusted with their
neighbours, and close loops. What a frame shows beyond its corners is the business of the dense map.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.geometry import check_pose, invert, relative_angle
from ms_slam_env.slam.alignment_check import (
    FEWEST_READINGS,
    NO_ALIGNMENT,
    AlignmentStatistics,
    DepthImage,
)
from ms_slam_env.slam.base import Float64, SlamBackend, TrackResult, Views
from ms_slam_env.slam.sparse.config import SparseConfig
from ms_slam_env.slam.sparse.dense_map import DenseMap
from ms_slam_env.slam.sparse.features import FeatureExtractor, InverseDepth
from ms_slam_env.slam.sparse.local_mapping import adjust_around, load_gtsam
from ms_slam_env.slam.sparse.localization import (
    Fix,
    LiveFrame,
    Localiser,
    Verifier,
    keyframe_features,
)
from ms_slam_env.slam.sparse.loop_closure import LoopCloser
from ms_slam_env.slam.sparse.matching import most_alike, thumbnail
from ms_slam_env.slam.sparse.sparse_map import SparseMap, make_keyframe

_LOOKALIKES = 4  # keyframes in which a lost camera is sought
_SOONER = 0.25  # share of a keyframe's distance that is enough where matches are few
_BESIDE = 2  # keyframes beside the guess in which it is sought


class SparseSlam(SlamBackend):
    """The sparse SLAM of one camera."""

    def __init__(self, intrinsics: Intrinsics, config: SparseConfig | None = None) -> None:
        """Start empty at the identity pose.

        Raises:
            InputError: GTSAM is not installed.
        """
        load_gtsam()
        self.intrinsics = intrinsics
        self.config = config or SparseConfig()
        self._extract = FeatureExtractor(intrinsics, self.config)
        self._dense = DenseMap(intrinsics, self.config)
        self.reset()

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self._pose = np.array(check_pose(pose, "T_world_camera"))
        self._motion = np.eye(4)
        self._lost = False
        self._reference = 0
        self._map = SparseMap(self.intrinsics)
        self._localiser = Localiser(self._map, self.config)
        self._verifier = Verifier(self._map, self.config)
        self._loops = LoopCloser(self._map, self._localiser, self._verifier, self.config)
        self._dense.clear()

    @property
    def sparse_map(self) -> SparseMap:
        """Keyframes and points."""
        return self._map

    @property
    def loops_closed(self) -> int:
        """Number of loops closed."""
        return len(self._loops.edges)

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame``; a keyframe extends the map. See ``SlamBackend``.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the guess is no pose.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        guess = None
        if T_world_camera_guess is not None:
            guess = np.array(check_pose(T_world_camera_guess, "T_world_camera_guess"))
        live = self._prepare(frame)
        if not self._map.keyframes:
            return self._start(frame, live)
        if live.image.readings < FEWEST_READINGS:
            return self._lose("the frame has too few depth readings", NO_ALIGNMENT)
        reason, statistics = "", NO_ALIGNMENT
        for fix in self._fixes(live, guess):
            verdict = self._verifier.judge(fix, live)
            if not verdict.reason:
                return self._accept(frame, live, fix, verdict.statistics)
            reason, statistics = verdict.reason, verdict.statistics
        nothing = f"fewer than {self.config.least_matches} of the frame's corners match the map"
        return self._lose(reason or nothing, statistics)

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Make ``frame`` a keyframe at a known pose (4, 4), which optimisation leaves.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the pose is none.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        self._pose = np.array(check_pose(T_world_camera, "T_world_camera"))
        self._motion = np.eye(4)
        self._lost = False
        live = self._prepare(frame)
        if live.image.readings >= FEWEST_READINGS:
            fix = None
            if self._map.keyframes:
                fix = self._localiser.near(live, self._pose, self._nearest(self._pose, 1)[0])
            self._insert(frame, live, fix, known=True)
        return TrackResult(self._pose.copy(), True)

    def _prepare(self, frame: RGBDFrame) -> LiveFrame:
        depth = frame.depth.astype(np.float32)
        depth = np.where(depth <= self.config.depth_cutoff_m, depth, np.float32(0))
        grey = intensity_image(frame.color)
        inverse_depth = InverseDepth(depth)
        features = self._extract(grey, inverse_depth)
        tree = cKDTree(features.pixels) if len(features) else None
        image = DepthImage(depth, grey.astype(np.float32))
        return LiveFrame(image, inverse_depth, features, tree)

    def _start(self, frame: RGBDFrame, live: LiveFrame) -> TrackResult:
        """Take the first frame at the given pose, if there is something in it."""
        corners = int((live.features.inverse_depth > 0).sum())
        reason = ""
        if live.image.readings < FEWEST_READINGS:
            reason = "the first frame has too few depth readings"
        elif corners < self.config.least_matches:
            reason = f"the first frame has only {corners} corners with depth"
        if reason:
            return TrackResult(self._pose.copy(), False, inlier_fraction=0.0, reason=reason)
        return self.fuse(frame, self._pose)

    def _fixes(self, live: LiveFrame, guess: Float64 | None) -> Iterator[Fix]:
        """Poses that the frame may have, in the order in which they are tried."""
        near, by_looks = self._localiser.near, self._localiser.by_looks
        starts = [(self._pose @ self._motion, self._reference)]
        if guess is not None:
            starts.append((guess, self._nearest(guess, 1)[0]))
        for pose, reference in starts:
            fix = near(live, pose, reference)
            if fix is not None:
                yield fix
        for reference in self._candidates(live, guess):
            found = by_looks(live, reference)
            fix = None if found is None else near(live, found, reference)
            if fix is not None:
                yield fix

    def _candidates(self, live: LiveFrame, guess: Float64 | None) -> list[int]:
        """Keyframes that the frame may look like, each once."""
        looks = [keyframe.thumbnail for keyframe in self._map.keyframes]
        wanted = thumbnail(live.image)
        candidates = [self._reference]
        if guess is not None:
            candidates += self._nearest(guess, _BESIDE)
        candidates += most_alike(wanted, looks, _LOOKALIKES)
        return list(dict.fromkeys(candidates))

    def _nearest(self, T_world_camera: Float64, count: int) -> list[int]:
        """Keyframes nearest to a pose; a turn of 0.5 rad counts as much as a metre."""
        poses = np.stack([keyframe.T_world_camera for keyframe in self._map.keyframes])
        away = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], T_world_camera[:3, :3]) - 1) / 2
        away += 2 * np.arccos(np.clip(cosine, -1, 1))
        return [int(k) for k in np.argsort(away, kind="stable")[:count]]

    def _accept(
        self, frame: RGBDFrame, live: LiveFrame, fix: Fix, statistics: AlignmentStatistics
    ) -> TrackResult:
        """Move on to a frame whose pose was found."""
        relocalised, self._lost = self._lost, False
        before = self._pose
        self._pose = fix.T_world_camera
        self._reference = fix.reference
        self._map.count_sightings(fix.visible, fix.point_ids)
        self._motion = np.eye(4) if relocalised else invert(before) @ self._pose
        if self._is_new(fix):
            self._insert(frame, live, fix, known=False)
        return TrackResult(
            T_world_camera=self._pose.copy(),
            tracking_ok=True,
            relocalised=relocalised,
            inlier_fraction=statistics.inlier_ratio,
            residual_m=statistics.residual_m,
        )

    def _is_new(self, fix: Fix) -> bool:
        """Whether a frame is away from the keyframe beside it; sooner where matches are few."""
        beside = self._map.keyframes[fix.reference].T_world_camera
        moved = float(np.linalg.norm(fix.T_world_camera[:3, 3] - beside[:3, 3]))
        turned = relative_angle(fix.T_world_camera[:3, :3], beside[:3, :3])
        share = 1.0 if len(fix.point_ids) >= self.config.enough_matches else _SOONER
        limit = np.radians(self.config.keyframe_deg)
        return moved > share * self.config.keyframe_m or turned > share * limit

    def _insert(self, frame: RGBDFrame, live: LiveFrame, fix: Fix | None, known: bool) -> None:
        """Make a frame a keyframe, adjust the map around it, and close a loop if there is one."""
        features, point_ids = keyframe_features(live, fix, self._map, self.config.pixel_noise)
        keyframe = make_keyframe(
            T_world_camera=self._pose,
            known=known,
            features=features,
            point_ids=point_ids,
            color=frame.color.copy(),
            intensity=live.image.intensity,
            depth=live.image.depth,
        )
        self._reference = index = self._map.add(keyframe)
        adjust_around(self._map, index, self.config)
        if self.config.loops and self._loops.close(index, live.showing(features)):
            adjust_around(self._map, index, self.config)
        self._pose = keyframe.T_world_camera.copy()
        self._dense.place(self._map.keyframes)

    def _lose(self, reason: str, statistics: AlignmentStatistics) -> TrackResult:
        """Hold the pose and the map."""
        self._motion = np.eye(4)
        self._lost = True
        return TrackResult(
            T_world_camera=self._pose.copy(),
            tracking_ok=False,
            inlier_fraction=statistics.inlier_ratio,
            residual_m=statistics.residual_m,
            reason=reason,
        )

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render the keyframes' depth from ``poses`` (N, 4, 4) at ``scale`` times the size.

        Raises:
            InputError: poses of another shape, or a scale outside (0, 1].
        """
        return self._surface().predict(poses, scale)

    def surface_points(self) -> Float64:
        """The keyframes' readings (M, 3), merged where they meet, world frame."""
        return self._surface().points()

    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``."""
        return self._surface().colors()

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Colour, normal, radius and confidence of ``surface_points``."""
        return self._surface().attributes()

    def _surface(self) -> DenseMap:
        self._dense.update(self._map.keyframes)
        return self._dense

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays and plain values."""
        return {
            "pose": self._pose.copy(),
            "motion": self._motion.copy(),
            "lost": self._lost,
            "reference": self._reference,
            "map": self._map.get_state(),
            "loops": self._loops.get_state(),
            "dense": self._dense.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of a sparse SLAM of the same intrinsics and configuration."""
        self._pose = state["pose"].copy()
        self._motion = state["motion"].copy()
        self._lost = state["lost"]
        self._reference = state["reference"]
        self._map.set_state(state["map"])
        self._loops.set_state(state["loops"])
        self._dense.set_state(state["dense"])
