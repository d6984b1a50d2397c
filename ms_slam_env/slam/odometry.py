"""RGB-D odometry against keyframes, as a backend."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, invert, relative_angle
from ms_slam_env.slam.alignment_check import (
    FEWEST_READINGS,
    NO_ALIGNMENT,
    VIEW_REASONS,
    VIEW_THRESHOLDS,
    AcceptanceThresholds,
    AlignmentStatistics,
    DepthImage,
    evaluate_alignment,
    measure_alignment,
)
from ms_slam_env.slam.base import Float64, SlamBackend, TrackResult, Views
from ms_slam_env.slam.starts import start_motions
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam


@dataclass(frozen=True)
class OdometryConfig:
    """Parameters of tracking and of the map of keyframes.

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        keyframe_m: the keyframe is renewed when the camera is this far from it,
        keyframe_deg: or turned by this much.
        least_overlap: share of a frame's readings that the image it is aligned with must show,
        least_inliers: share of those that must fit its depth,
        least_alike: share of those that must fit its intensity.
        max_surfels: capacity of the map; None as in ``SurfelConfig``.

    Raises:
        InputError: a value outside its range.
    """

    depth_cutoff_m: float = 4.0
    keyframe_m: float = 0.04
    keyframe_deg: float = 3.0
    least_overlap: float = 0.3
    least_inliers: float = 0.75
    least_alike: float = 0.9
    max_surfels: int | None = None

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "depth_cutoff_m", 0.1, 10.0)
        check_range(self, "keyframe_m", 0.0, 1.0)
        check_range(self, "keyframe_deg", 0.0, 90.0)
        check_range(self, "least_overlap", 0.0, 1.0)
        check_range(self, "least_inliers", 0.0, 1.0)
        check_range(self, "least_alike", 0.0, 1.0)
        if self.max_surfels is not None:
            check_range(self, "max_surfels", 1000, 50_000_000)


@dataclass(frozen=True)
class PreparedImage:
    """An image and OpenCV's pyramids of it."""

    image: DepthImage
    pyramids: cv2.OdometryFrame


class Aligner:
    """``cv2.Odometry`` on colour and depth with OpenCV's default settings.

    Args:
        intrinsics: of both images.
        depth_cutoff_m: readings beyond are ignored.

    Raises:
        InputError: OpenCV is older than 5 and has no ``cv2.Odometry``.
    """

    def __init__(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        if int(cv2.__version__.split(".")[0]) < 5:
            raise InputError(
                "this backend needs OpenCV 5 (pip install 'opencv-python-headless>=5'), found "
                f"{cv2.__version__}"
            )
        settings = cv2.OdometrySettings()
        matrix = np.eye(3, dtype=np.float32)
        matrix[0, 0], matrix[1, 1] = intrinsics.fx, intrinsics.fy
        matrix[0, 2], matrix[1, 2] = intrinsics.cx, intrinsics.cy
        settings.setCameraMatrix(matrix)
        settings.setMaxDepth(depth_cutoff_m)
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )

    def prepare(self, image: DepthImage) -> PreparedImage:
        """Build the pyramids of an image; ``align`` takes images so prepared."""
        depth = np.where(image.depth > 0, image.depth, np.float32(np.nan))
        grey = np.clip(np.rint(image.intensity), 0, 255).astype(np.uint8)
        pyramids = cv2.OdometryFrame(depth, grey)
        self._odometry.prepareFrame(pyramids)
        return PreparedImage(image, pyramids)

    def align(self, frame: PreparedImage, reference: PreparedImage) -> Float64 | None:
        """T_reference_frame (4, 4), or None if OpenCV found none.

        The search starts at rest: OpenCV 5 ignores an initial guess.
        """
        found, T = self._odometry.compute(frame.pyramids, reference.pyramids)
        if not found or T is None or not np.isfinite(T).all():
            return None
        return np.asarray(T, dtype=np.float64)


@dataclass(frozen=True)
class _Placed:
    """An image at a pose."""

    T_world_image: Float64
    prepared: PreparedImage


class OdometrySlam(SlamBackend):
    """Keyframe odometry through OpenCV, its keyframes fused into a surfel map."""

    def __init__(self, intrinsics: Intrinsics, config: OdometryConfig | None = None) -> None:
        """Start empty at the identity pose."""
        self.intrinsics = intrinsics
        self.config = config or OdometryConfig()
        self._aligner = Aligner(intrinsics, self.config.depth_cutoff_m)
        self._thresholds = replace(
            VIEW_THRESHOLDS,
            overlap=self.config.least_overlap,
            inlier_ratio=self.config.least_inliers,
            photometric_inlier_ratio=self.config.least_alike,
        )
        self._map = SurfelSlam(
            intrinsics,
            SurfelConfig(
                depth_cutoff_m=self.config.depth_cutoff_m, max_surfels=self.config.max_surfels
            ),
        )
        self.reset()

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self._pose = np.array(check_pose(pose, "T_world_camera"))
        self._key: _Placed | None = None
        self._last: _Placed | None = None
        self._motion = np.eye(4)
        self._lost = False
        self._map.reset(self._pose)

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame``; a keyframe is fused into the map. See ``SlamBackend``.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the guess is no pose.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        guess = None
        if T_world_camera_guess is not None:
            guess = np.array(check_pose(T_world_camera_guess, "T_world_camera_guess"))
        image = self._image(frame)
        if self._key is None or self._last is None:
            return self._start(frame, image)
        if image.readings < FEWEST_READINGS:
            return self._lose("the frame has too few depth readings", NO_ALIGNMENT)
        prepared = self._aligner.prepare(image)
        reason, statistics = "", NO_ALIGNMENT
        for reference in self._sensed(self._key, self._last):
            T, statistics, reason = self._align(prepared, reference, self._thresholds)
            if not reason:
                return self._accept(frame, _Placed(T, prepared), statistics)
        for reference in self._rendered(image, self._last, guess):
            lax = self._thresholds.tentative
            T, statistics, reason = self._align(prepared, reference, lax)
            if reason:
                continue
            for closer in self._views(T[None]):
                T, statistics, reason = self._align(prepared, closer, self._thresholds.confirmation)
                if not reason:
                    return self._accept(frame, _Placed(T, prepared), statistics)
        return self._lose(reason or "too little of the map is in view", statistics)

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` as a keyframe at a known pose (4, 4), without tracking.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the pose is none.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        self._pose = np.array(check_pose(T_world_camera, "T_world_camera"))
        image = self._image(frame)
        if image.readings >= FEWEST_READINGS:  # nothing can be aligned with less
            self._key = self._last = _Placed(self._pose, self._aligner.prepare(image))
        self._map.fuse(frame, self._pose)
        self._motion = np.eye(4)
        self._lost = False
        return TrackResult(self._pose.copy(), True)

    def _image(self, frame: RGBDFrame) -> DepthImage:
        depth = frame.depth.astype(np.float32)
        depth = np.where(depth <= self.config.depth_cutoff_m, depth, np.float32(0))
        return DepthImage(depth, intensity_image(frame.color).astype(np.float32))

    def _start(self, frame: RGBDFrame, image: DepthImage) -> TrackResult:
        """Take the first frame at the given pose, if there is something in it."""
        if image.readings < FEWEST_READINGS:
            reason = "the first frame has too few depth readings"
            return TrackResult(self._pose.copy(), False, inlier_fraction=0.0, reason=reason)
        return self.fuse(frame, self._pose)

    def _sensed(self, key: _Placed, last: _Placed) -> Iterator[_Placed]:
        """Earlier frames to align a frame with, in the order in which they are tried."""
        yield key
        if last is not key:
            yield last

    def _rendered(
        self, image: DepthImage, last: _Placed, guess: Float64 | None
    ) -> Iterator[_Placed]:
        """Views of the map to align ``image`` with where the earlier frames fail."""
        if guess is not None:
            yield from self._views(guess[None])
        seen = last.prepared.image
        motions = start_motions(image, seen, self._motion, self.intrinsics)
        yield from self._views(last.T_world_image @ motions)

    def _views(self, poses: Float64) -> Iterator[_Placed]:
        """Views of the map from poses (N, 4, 4), those with enough in them."""
        views = self._map.predict(poses)
        for pose, depth, intensity in zip(poses, views.depth, views.intensity, strict=True):
            image = DepthImage(depth, intensity)
            if image.readings >= FEWEST_READINGS:
                yield _Placed(pose, self._aligner.prepare(image))

    def _align(
        self, frame: PreparedImage, reference: _Placed, thresholds: AcceptanceThresholds
    ) -> tuple[Float64, AlignmentStatistics, str]:
        """T_world_frame, what it explains, and why it is not to be believed or nothing."""
        T = self._aligner.align(frame, reference.prepared)
        if T is None:
            reason = "no motion aligns the frame with the view before it"
            return reference.T_world_image, NO_ALIGNMENT, reason
        statistics = measure_alignment(frame.image, reference.prepared.image, T, self.intrinsics)
        return (
            reference.T_world_image @ T,
            statistics,
            VIEW_REASONS[evaluate_alignment(statistics, thresholds)],
        )

    def _accept(
        self, frame: RGBDFrame, placed: _Placed, statistics: AlignmentStatistics
    ) -> TrackResult:
        """Move on to a frame whose pose was found."""
        assert self._key is not None
        relocalised, self._lost = self._lost, False
        self._motion = np.eye(4) if relocalised else invert(self._pose) @ placed.T_world_image
        self._pose = placed.T_world_image
        self._last = placed
        motion = invert(self._key.T_world_image) @ self._pose
        moved = float(np.linalg.norm(motion[:3, 3]))
        turned = relative_angle(np.eye(3), motion[:3, :3])
        limit = np.radians(self.config.keyframe_deg)
        if moved > self.config.keyframe_m or turned > limit:
            self._key = placed
            self._map.fuse(frame, self._pose)
        return TrackResult(
            T_world_camera=self._pose.copy(),
            tracking_ok=True,
            relocalised=relocalised,
            inlier_fraction=statistics.inlier_ratio,
            residual_m=statistics.residual_m,
        )

    def _lose(self, reason: str, statistics: AlignmentStatistics) -> TrackResult:
        """Hold the pose and the images that frames are aligned with."""
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
        """Render the map from ``poses`` (N, 4, 4) T_world_camera at ``scale`` times the size.

        Raises:
            InputError: poses of another shape, or a scale outside (0, 1].
        """
        return self._map.predict(poses, scale)

    def surface_points(self) -> Float64:
        """The keyframes' readings (M, 3), merged where they meet, world frame."""
        return self._map.surface_points()

    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``."""
        return self._map.surface_colors()

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Colour, normal, radius and confidence of ``surface_points``."""
        return self._map.map_attributes()

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return {
            "pose": self._pose.copy(),
            "motion": self._motion.copy(),
            "lost": self._lost,
            "key": _save(self._key),
            "last": "key" if self._last is self._key else _save(self._last),
            "map": self._map.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of an odometry of the same intrinsics and configuration."""
        self._pose = state["pose"].copy()
        self._motion = state["motion"].copy()
        self._lost = state["lost"]
        self._key = self._restore(state["key"])
        self._last = self._key if state["last"] == "key" else self._restore(state["last"])
        self._map.set_state(state["map"])

    def _restore(self, saved: dict[str, Any] | None) -> _Placed | None:
        if saved is None:
            return None
        image = DepthImage(saved["depth"].copy(), saved["intensity"].copy())
        return _Placed(saved["pose"].copy(), self._aligner.prepare(image))


def _save(placed: _Placed | None) -> dict[str, Any] | None:
    """An image and its pose as arrays; OpenCV's pyramids follow from them."""
    if placed is None:
        return None
    image = placed.prepared.image
    return {
        "pose": placed.T_world_image.copy(),
        "depth": image.depth.copy(),
        "intensity": image.intensity.copy(),
    }
