"""The sparse SLAM backend, with ORB features.

ORB-SLAM2 for RGB-D cameras (Mur-Artal and Tardos, TRO 2017, figure 2) without its threads: every
frame is matched with the points of the local map; keyframes add points, are adjusted with their
neighbours, and close loops. A separate dense map holds everything beyond the corners.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.geometry import relative_angle
from ms_slam_env.slam.shared.alignment_measures import DepthImage
from ms_slam_env.slam.shared.feature_matching import most_alike, thumbnail
from ms_slam_env.slam.shared.orb_features import FeatureExtractor, InverseDepth
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import Fields, ListOf, WholeNumber
from ms_slam_env.slam.shared.tracking_template import Attempt, FrameByFrameSlam
from ms_slam_env.slam.slam_backend import BorrowedMap, Loop, TrackResult
from ms_slam_env.slam.sparse.local_mapping import adjust_around, load_gtsam
from ms_slam_env.slam.sparse.localization import Fix, LiveFrame, Localizer, keyframe_features
from ms_slam_env.slam.sparse.pose_graph import LoopCloser
from ms_slam_env.slam.sparse.sparse_config import LEAST_MATCHES, PIXEL_NOISE, SparseConfig
from ms_slam_env.slam.sparse.sparse_map import Keyframe, SparseMap
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam

_KEYFRAME_M, _KEYFRAME_DEG = 0.1, 8.0
"""A frame becomes a keyframe at this distance from its reference keyframe, or this rotation."""
_ENOUGH_MATCHES = 60  # with fewer, only the share ``_SOONER`` of that motion is needed
_REMAP_M, _REMAP_DEG = 0.005, 0.3
"""The dense map is rebuilt when a keyframe has moved by this much since it was fused."""


class DenseMap(Saved):
    """Surfels fused from keyframes at their poses; rebuilt when a pose has changed."""

    saved = ("_surfels", "_poses", "_fused")

    def __init__(self, intrinsics: Intrinsics, config: SparseConfig) -> None:
        self._surfels = SurfelSlam(
            intrinsics,
            SurfelConfig.of_mapper(
                depth_cutoff_m=config.depth_cutoff_m,
                max_surfels=config.max_surfels,
                unstable_window=100_000,  # keyframes are few, and each one counts
            ),
        )
        self._poses: list[Float64] = []  # pose of each keyframe in the map
        self._fused = 0  # how many of them are fused

    def state_like(self) -> Any:
        """See ``Stateful``."""
        placed = {"poses": ListOf(np.eye(4), "keyframes"), "fused": WholeNumber(most="keyframes")}
        return super().state_like() | placed

    def clear(self) -> None:
        """Forget everything."""
        self._surfels.reset()
        self._poses = []
        self._fused = 0

    def place(self, keyframes: Sequence[Keyframe]) -> None:
        """Set the keyframes' poses in the map; nothing is fused until the map is used."""
        pairs = zip(self._poses, keyframes, strict=False)
        if any(self._has_moved(placed, keyframe) for placed, keyframe in pairs):
            self.clear()
        for keyframe in keyframes[len(self._poses) :]:
            self._poses.append(keyframe.T_world_camera.copy())

    def updated(self, keyframes: Sequence[Keyframe]) -> SurfelSlam:
        """Fuse the placed keyframes, and return the surfels."""
        for keyframe, pose in zip(
            keyframes[self._fused :], self._poses[self._fused :], strict=True
        ):
            self._surfels.fuse(RGBDFrame(keyframe.color, keyframe.depth), pose)
            self._fused += 1
        return self._surfels

    def _has_moved(self, placed: Float64, keyframe: Keyframe) -> bool:
        pose = keyframe.T_world_camera
        if np.array_equal(placed, pose):
            return False
        moved_m = float(np.linalg.norm(placed[:3, 3] - pose[:3, 3]))
        turned = np.degrees(relative_angle(placed[:3, :3], pose[:3, :3]))
        return moved_m > _REMAP_M or turned > _REMAP_DEG


_LOOKALIKES = 4  # keyframes in which a lost camera is searched for
_SOONER = 0.25  # share of the keyframe motion that is enough if there are few matches
_BESIDE = 2  # keyframes nearest the guess in which it is searched for


class SparseSlam(BorrowedMap, FrameByFrameSlam[LiveFrame, Fix]):
    """The sparse SLAM of one camera."""

    saved = (*FrameByFrameSlam.saved, "_reference", "_frame", "_map", "_loops", "_dense")

    def __init__(self, intrinsics: Intrinsics, config: SparseConfig | None = None) -> None:
        """Start empty at the identity pose."""
        load_gtsam()
        self.intrinsics = intrinsics
        self.config = config or SparseConfig()
        self._extract = FeatureExtractor(intrinsics, self.config.features, self.config.levels)
        self._dense = DenseMap(intrinsics, self.config)
        super().__init__(intrinsics)

    @property
    def needs_color(self) -> bool:
        """Corners are detected in the colour image."""
        return True

    @property
    def _has_map(self) -> bool:
        return bool(self._map.keyframes)

    @property
    def _no_attempt(self) -> str:
        return f"fewer than {LEAST_MATCHES} of the frame's corners match the map"

    def _clear(self) -> None:
        self._reference = self._frame = 0
        self._loop: Loop | None = None  # closed by the current frame
        self._map = SparseMap(self.intrinsics)
        self._localizer = Localizer(self._map)
        self._loops = LoopCloser(self._map, self._localizer)
        self._dense.clear()

    @property
    def sparse_map(self) -> SparseMap:
        """Keyframes and points."""
        return self._map

    @property
    def loops_closed(self) -> int:
        """Number of loops closed."""
        return len(self._loops.edges)

    @property
    def closes_loops(self) -> bool:
        """Whether loop closure is enabled."""
        return self.config.loops

    @property
    def frames_counted(self) -> int:
        """Number of the next frame."""
        return self._frame

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and extend the map; see ``SlamBackend``."""
        return self._counted(super().track(frame, T_world_camera_guess))

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Make ``frame`` a keyframe at a known pose (4, 4), without tracking."""
        return self._counted(super().fuse(frame, T_world_camera))

    def _counted(self, result: TrackResult) -> TrackResult:
        """Count a frame, and add the loop that it closed to its result."""
        loop, self._loop = self._loop, None
        self._frame += 1
        return replace(result, loop=loop, loop_closed=loop is not None and loop.bent)

    def _prepare(self, frame: RGBDFrame) -> LiveFrame:
        depth = frame.depth.astype(np.float32)
        depth = np.where(depth <= self.config.depth_cutoff_m, depth, np.float32(0))
        grey = intensity_image(frame.color)
        inverse_depth = InverseDepth(depth)
        features = self._extract(grey, inverse_depth)
        tree = cKDTree(features.pixels) if len(features) else None
        image = DepthImage(depth, grey.astype(np.float32))
        return LiveFrame(image, inverse_depth, features, tree)

    def _why_no_start(self, prepared: LiveFrame) -> str:
        corners = int((prepared.features.inverse_depth > 0).sum())
        if corners < LEAST_MATCHES:
            return f"the first frame has only {corners} corners with depth"
        return ""

    def _attempts(self, prepared: LiveFrame, guess: Float64 | None) -> Iterator[Attempt[Fix]]:
        for fix in self._fixes(prepared, guess):
            yield self._localizer.verify(fix, prepared)

    def _fixes(self, live: LiveFrame, guess: Float64 | None) -> Iterator[Fix]:
        """Candidate poses of the frame, in the order in which they are tried."""
        near, by_looks = self._localizer.near, self._localizer.by_looks
        hypotheses = [(self._pose @ self._motion, self._reference)]
        if guess is not None:
            hypotheses.append((guess, self._nearest(guess, 1)[0]))
        for pose, reference in hypotheses:
            fix = near(live, pose, reference)
            if fix is not None:
                yield fix
        for reference in self._candidates(live, guess):
            found = by_looks(live, reference)
            fix = None if found is None else near(live, found, reference)
            if fix is not None:
                yield fix

    def _candidates(self, live: LiveFrame, guess: Float64 | None) -> list[int]:
        """Keyframes that may show the same place, each once."""
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

    def _start_from(self, frame: RGBDFrame, prepared: LiveFrame) -> None:
        if prepared.readings >= self.fewest_readings:
            fix = None
            if self._has_map:
                fix = self._localizer.near(prepared, self._pose, self._nearest(self._pose, 1)[0])
            self._insert(frame, prepared, fix, known=True)

    def _extend(self, frame: RGBDFrame, prepared: LiveFrame, attempt: Attempt[Fix]) -> None:
        fix = attempt.match
        self._reference = fix.reference
        self._map.count_sightings(fix.visible, fix.point_ids)
        if self._is_new(fix):
            self._insert(frame, prepared, fix, known=False)

    def _is_new(self, fix: Fix) -> bool:
        """Whether a frame is far enough from its reference keyframe; less if matches are few."""
        beside = self._map.keyframes[fix.reference].T_world_camera
        moved = float(np.linalg.norm(fix.T_world_camera[:3, 3] - beside[:3, 3]))
        turned = relative_angle(fix.T_world_camera[:3, :3], beside[:3, :3])
        share = 1.0 if len(fix.point_ids) >= _ENOUGH_MATCHES else _SOONER
        limit = np.radians(_KEYFRAME_DEG)
        return moved > share * _KEYFRAME_M or turned > share * limit

    def _insert(self, frame: RGBDFrame, live: LiveFrame, fix: Fix | None, known: bool) -> None:
        """Make a frame a keyframe, adjust the map around it, and close a loop if there is one."""
        features, point_ids = keyframe_features(live, fix, self._map, PIXEL_NOISE)
        keyframe = Keyframe(
            T_world_camera=self._pose,
            known=known,
            frame=self._frame,
            features=features,
            point_ids=point_ids,
            color=frame.color.copy(),
            intensity=live.image.intensity,
            depth=live.image.depth,
        )
        self._reference = index = self._map.add(keyframe)
        adjust_around(self._map, index, self.config.window)
        if self.config.loops:
            self._loop = self._loops.close(index, live.showing(features))
        if self._loop is not None:
            adjust_around(self._map, index, self.config.window)
        self._pose = keyframe.T_world_camera.copy()
        self._dense.place(self._map.keyframes)

    def state_like(self) -> Any:
        """See ``Stateful``."""
        like = super().state_like() | {"reference": WholeNumber(index_of="keyframes")}
        return Fields(like, _why_no_frame)

    @property
    def _mapper(self) -> SurfelSlam:
        return self._dense.updated(self._map.keyframes)


def _why_no_frame(state: dict[str, Any]) -> str:
    """What is inconsistent between a state's frame count and its keyframes."""
    keyframes = state["map"]["keyframes"]
    is_later = keyframes and keyframes[-1]["frame"] >= state["frame"]
    return "has keyframes of later frames than it has counted" if is_later else ""
