"""RGB-D keyframe odometry as a backend, the baseline for SLAM.

Every frame is aligned with the keyframe; failing that, with the last good frame; failing that, with
views of the map, from the caller's guess and from poses around the last one. The map holds the
keyframes' readings at their estimated poses; errors add up from keyframe to keyframe.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.slam.odometry.semi_dense import SemiDenseAligner
from ms_slam_env.slam.shared.alignment_check import NO_ALIGNMENT, AcceptanceThresholds
from ms_slam_env.slam.shared.alignment_measures import DepthImage, check_alignment
from ms_slam_env.slam.shared.state_check import ArrayOf, OrNone
from ms_slam_env.slam.shared.tracking_template import Attempt, FrameByFrameSlam, motion_hypotheses
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M, BorrowedMap
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam

_TOO_LITTLE_IN_VIEW = "too little of the map is in view"


@dataclass(frozen=True)
class OdometryConfig(Checked):
    """Parameters of tracking and of the keyframe map.

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        keyframe_m: distance from the keyframe at which a new one starts.
        keyframe_deg: rotation from the keyframe at which a new one starts.
        max_surfels: capacity of the map; None as in ``SurfelConfig``.
        aligner: how two images are aligned: ``opencv`` (depth and intensity of all pixels) or
            ``semi-dense`` (intensity of pixels with a strong gradient, as in LSD-SLAM).
        stock: unmodified OpenCV odometry: every motion that it returns is accepted without checks,
            views of the map are not used, and a frame that it cannot align becomes the keyframe at
            the last pose.
    """

    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    keyframe_m: float = bounded(0.04, 0.0, 1.0)
    keyframe_deg: float = bounded(3.0, 0.0, 90.0)
    max_surfels: int | None = bounded(None, 1000, 50_000_000)
    aligner: str = chosen("opencv", "opencv", "semi-dense")
    stock: bool = False


@dataclass(frozen=True)
class PreparedImage:
    """An image, and its form prepared by the aligner."""

    image: DepthImage
    pyramids: Any


class ImageAligner(Protocol):
    """Finds the motion between two images."""

    def prepare(self, image: DepthImage) -> Any:
        """Prepare an image for ``align``."""

    def align(self, frame: Any, reference: Any) -> Float64 | None:
        """Align from rest; return T_reference_frame (4, 4) or None."""


class Aligner:
    """``cv2.Odometry`` on colour and depth with OpenCV's default settings."""

    def __init__(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        if int(cv2.__version__.split(".")[0]) < 5:
            raise InputError(
                "this backend needs OpenCV 5 (pip install 'opencv-python-headless>=5'), found "
                f"{cv2.__version__}"
            )
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(intrinsics.matrix.astype(np.float32))
        settings.setMaxDepth(depth_cutoff_m)
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )

    def prepare(self, image: DepthImage) -> cv2.OdometryFrame:
        """Build an image's pyramids for ``align``."""
        depth = np.where(image.depth > 0, image.depth, np.float32(np.nan))
        grey = np.clip(np.rint(image.intensity), 0, 255).astype(np.uint8)
        pyramids = cv2.OdometryFrame(depth, grey)
        self._odometry.prepareFrame(pyramids)
        return pyramids

    def align(self, frame: cv2.OdometryFrame, reference: cv2.OdometryFrame) -> Float64 | None:
        """T_reference_frame (4, 4), or None if OpenCV found none.

        The search starts at rest: OpenCV 5 ignores an initial guess.
        """
        found, T = self._odometry.compute(frame, reference)
        if not found or T is None or not np.isfinite(T).all():
            return None
        return np.asarray(T, dtype=np.float64)


@dataclass(frozen=True)
class _Placed:
    """An image at a pose."""

    T_world_image: Float64
    prepared: PreparedImage


class OdometrySlam(BorrowedMap, FrameByFrameSlam[DepthImage, _Placed]):
    """Keyframe odometry with OpenCV; keyframes are fused into a surfel map."""

    saved = (*FrameByFrameSlam.saved, "_map")
    also_saved = ("key", "last")

    def __init__(self, intrinsics: Intrinsics, config: OdometryConfig | None = None) -> None:
        self.config = config or OdometryConfig()
        self._aligner: ImageAligner = (
            SemiDenseAligner(intrinsics)
            if self.config.aligner == "semi-dense"
            else Aligner(intrinsics, self.config.depth_cutoff_m)
        )
        self._judge_views(self.config.stock)
        kept = {name: getattr(self.config, name) for name in ("depth_cutoff_m", "max_surfels")}
        self._map = SurfelSlam(intrinsics, SurfelConfig.of_mapper(**kept))
        super().__init__(intrinsics)

    @property
    def _has_map(self) -> bool:
        return self._key is not None

    @property
    def _no_attempt(self) -> str:
        return _TOO_LITTLE_IN_VIEW

    def _clear(self) -> None:
        self._key: _Placed | None = None
        self._last: _Placed | None = None
        self._map.reset(self._pose)

    def _prepare(self, frame: RGBDFrame) -> DepthImage:
        depth = frame.depth.astype(np.float32)
        depth = np.where(depth <= self.config.depth_cutoff_m, depth, np.float32(0))
        return DepthImage(depth, intensity_image(frame.color).astype(np.float32))

    def _prepared(self, image: DepthImage) -> PreparedImage:
        return PreparedImage(image, self._aligner.prepare(image))

    def _attempts(self, prepared: DepthImage, guess: Float64 | None) -> Iterator[Attempt[_Placed]]:
        assert self._key is not None
        assert self._last is not None
        frame = self._prepared(prepared)
        yield self._align(frame, self._key, self._thresholds)
        if self._last is not self._key:
            yield self._align(frame, self._last, self._thresholds)
        if not self.config.stock:
            for reference in self._rendered(prepared, self._last, guess):
                yield self._confirmed(frame, reference)

    def _confirmed(self, frame: PreparedImage, reference: _Placed) -> Attempt[_Placed]:
        """Align with a view of the map; if plausible, align again with the view from the result."""
        attempt = self._align(frame, reference, self._thresholds.tentative)
        if attempt.reason:
            return attempt
        for closer in self._views(attempt.T_world_camera[None]):
            return self._align(frame, closer, self._thresholds.confirmation)
        return replace(attempt, reason=_TOO_LITTLE_IN_VIEW)

    def _rendered(
        self, image: DepthImage, last: _Placed, guess: Float64 | None
    ) -> Iterator[_Placed]:
        """Views of the map to align ``image`` with if the earlier frames fail."""
        if guess is not None:
            yield from self._views(guess[None])
        if not self._searches:
            return
        seen = last.prepared.image
        motions = motion_hypotheses(image, seen, self._motion, self.intrinsics)
        yield from self._views(last.T_world_image @ motions)

    def _views(self, poses: Float64) -> Iterator[_Placed]:
        """Views of the map from poses (N, 4, 4), if they show enough."""
        views = self._map.predict(poses)
        for pose, depth, intensity in zip(poses, views.depth, views.intensity, strict=True):
            image = DepthImage(depth, intensity)
            if image.readings >= self.fewest_readings:
                yield _Placed(pose, self._prepared(image))

    def _align(
        self, frame: PreparedImage, reference: _Placed, thresholds: AcceptanceThresholds
    ) -> Attempt[_Placed]:
        T = self._aligner.align(frame.pyramids, reference.prepared.pyramids)
        if T is None:
            reason = "no motion aligns the frame with the view before it"
            return Attempt(reference.T_world_image, NO_ALIGNMENT, reason, reference)
        images = frame.image, reference.prepared.image
        found, *refused = check_alignment(*images, T, self.intrinsics, thresholds)
        pose = reference.T_world_image @ T
        return Attempt(pose, found, refused[0], _Placed(pose, frame), refused[1])

    def _start_from(self, frame: RGBDFrame, prepared: DepthImage) -> None:
        if prepared.readings >= self.fewest_readings:  # nothing can be aligned with less
            self._key = self._last = _Placed(self._pose, self._prepared(prepared))
        self._map.fuse(frame, self._pose)

    def _extend(self, frame: RGBDFrame, prepared: DepthImage, attempt: Attempt[_Placed]) -> None:
        assert self._key is not None
        self._last = attempt.match
        motion = invert(self._key.T_world_image) @ self._pose
        moved = float(np.linalg.norm(motion[:3, 3]))
        turned = relative_angle(np.eye(3), motion[:3, :3])
        if moved > self.config.keyframe_m or turned > np.radians(self.config.keyframe_deg):
            self._key = attempt.match
            self._map.fuse(frame, self._pose)

    def _miss(self, frame: RGBDFrame, prepared: DepthImage) -> None:
        if self.config.stock:
            self._start_from(frame, prepared)

    @property
    def _mapper(self) -> SurfelSlam:
        return self._map

    def get_state(self) -> dict[str, Any]:
        """Pose and motion, the images that frames are aligned with, and the map."""
        return super().get_state() | {
            "key": _save(self._key),
            "last": None if self._last is self._key else _save(self._last),
        }

    def state_like(self) -> Any:
        """See ``Stateful``."""
        image = ArrayOf(np.float32, self.intrinsics.shape, least=0)
        placed = OrNone({"pose": np.eye(4), "depth": image, "intensity": image})
        return super().state_like() | {"key": placed, "last": placed}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state of a backend with the same intrinsics and configuration."""
        super().set_state(state)
        self._key = self._restore(state["key"])
        self._last = self._key if state["last"] is None else self._restore(state["last"])

    def _restore(self, saved: dict[str, Any] | None) -> _Placed | None:
        if saved is None:
            return None
        image = DepthImage(saved["depth"].copy(), saved["intensity"].copy())
        return _Placed(saved["pose"].copy(), self._prepared(image))


def _save(placed: _Placed | None) -> dict[str, Any] | None:
    """An image and its pose as arrays; pyramids are rebuilt from them."""
    if placed is None:
        return None
    image = placed.prepared.image
    return {
        "pose": placed.T_world_image.copy(),
        "depth": image.depth.copy(),
        "intensity": image.intensity.copy(),
    }
