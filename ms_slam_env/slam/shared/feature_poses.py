"""Camera poses from ORB features that a frame shares with an earlier frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.shared.feature_matching import match_anywhere
from ms_slam_env.slam.shared.images import Images, ImageStore
from ms_slam_env.slam.shared.orb_features import FeatureExtractor, Features, InverseDepth
from ms_slam_env.slam.shared.point_poses import (
    Sightings,
    pose_from_matches,
    refine_pose,
    sighting_covariance,
)
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ListOf, WholeNumber

_HAMMING = 60  # largest distance of matching descriptors, bits of 256
_ERROR_PX = 2.5  # largest reprojection error of a RANSAC inlier
_PIXEL_NOISE = 0.7  # position noise of a corner of the finest level, as in ``sparse_config``
_INVERSE_DEPTH_NOISE = 0.004  # 1/m
STRONG_SUPPORT = 30  # matches that a pose which can stand alone explains
STRONG_SIGMA_M = 0.03  # largest standard deviation of its position, by the noise of corners


@dataclass(frozen=True)
class FeaturePose:
    """A pose supported by feature matches."""

    T_reference_frame: Float64  # (4, 4)
    inliers: int  # matches that it explains, in the image and in depth
    covariance: Float64  # (6, 6) of the twist (rho, phi), T_reference_frame exp(twist)

    @property
    def is_strong(self) -> bool:
        """Whether its support suffices without other evidence."""
        sigma_m = np.sqrt(np.trace(self.covariance[:3, :3]))
        return self.inliers >= STRONG_SUPPORT and bool(sigma_m <= STRONG_SIGMA_M)


def pose_from_features(
    reference: Features, frame: Features, intrinsics: Intrinsics
) -> FeaturePose | None:
    """Estimate a frame's pose relative to another by PnP and RANSAC, refined with both depths.

    None if too few features match. The same features give the same pose, bit for bit.
    """
    known = reference.chosen(np.flatnonzero(reference.inverse_depth > 0))
    a, b = match_anywhere(known.descriptors, frame.descriptors, _HAMMING)
    points, seen = known.points(intrinsics)[a], frame.chosen(b)
    found = pose_from_matches(points, seen.pixels, intrinsics, _ERROR_PX)
    if found is None:
        return None
    kept = np.flatnonzero(found[1])
    points, seen = points[kept], seen.chosen(kept)
    sightings = Sightings(
        seen.pixels, seen.inverse_depth, _PIXEL_NOISE * seen.scale, _INVERSE_DEPTH_NOISE
    )
    T, inlier = refine_pose(found[0], points, sightings, intrinsics)
    if not inlier.any():
        return None
    used = np.flatnonzero(inlier)
    covariance = sighting_covariance(T, points[used], sightings.chosen(used), intrinsics)
    return FeaturePose(T, int(inlier.sum()), covariance)


class FrameFeatures:
    """Extracts features from the frames of one camera."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self.intrinsics = intrinsics
        self._extract = FeatureExtractor(intrinsics)

    def features_of(self, image: NDArray[np.uint8], depth: Float32, cutoff_m: float) -> Features:
        """Features of a grey (H, W) or colour (H, W, 3) frame, with depth (H, W) up to a cutoff."""
        grey = image if image.ndim == 2 else grey_of(image)
        within = np.where(depth <= cutoff_m, depth, np.float32(0))
        return self._extract(grey, InverseDepth(within))


def grey_of(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a colour image (H, W, 3) to grey (H, W)."""
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY))


MOST_IMAGES = 100


class KeyframeImages(FrameFeatures, Saved):
    """Keyframe images of one camera; features are extracted on request.

    When there are more than ``MOST_IMAGES``, every second one is dropped, so that they stay spread
    over time.
    """

    saved = ("times", "_grey", "_depth")

    def __init__(self, intrinsics: Intrinsics) -> None:
        super().__init__(intrinsics)
        self.clear()

    def clear(self) -> None:
        """Forget all images."""
        self.times: list[int] = []
        self._grey: list[NDArray[np.uint8]] = []
        self._depth: list[Float32] = []
        self._found: dict[tuple[int, float], Features] = {}

    def keep(self, color: NDArray[np.uint8], depth: Float32, time: int) -> None:
        """Store a keyframe's image."""
        self.times.append(time)
        self._grey.append(grey_of(color))
        self._depth.append(depth.copy())
        if len(self.times) > MOST_IMAGES:
            kept: list[list[Any]] = [self.times, self._grey, self._depth]
            for each in kept:
                del each[1::2]
        self._found = {key: one for key, one in self._found.items() if key[0] in self.times}

    def features(self, time: int, cutoff_m: float) -> Features:
        """Features of the keyframe at ``time``, which must be one of ``times``."""
        key, index = (time, cutoff_m), self.times.index(time)
        if key not in self._found:
            images = self._grey[index], self._depth[index]
            self._found[key] = self.features_of(*images, cutoff_m)
        return self._found[key]

    def fitting(self, intrinsics: Intrinsics) -> KeyframeImages:
        """Return itself if the intrinsics match, otherwise an empty store for them."""
        return self if intrinsics == self.intrinsics else KeyframeImages(intrinsics)

    def state_like(self) -> Any:
        """See ``Stateful``."""
        shape = self.intrinsics.shape
        return {
            "times": ListOf(WholeNumber(), "images"),
            "grey": ListOf(np.zeros(shape, np.uint8), "images"),
            "depth": ListOf(np.zeros(shape, np.float32), "images"),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state; features are extracted again on request."""
        super().set_state(state)
        self._found = {}


class LastFrames(Saved):
    """The last frame with a known pose of each of B envs; features are extracted on request."""

    saved = ("_poses",)
    also_saved = ("color", "depth")

    def __init__(self, batch: int, intrinsics: Intrinsics) -> None:
        self._poses: Float64 = np.full((batch, 4, 4), np.nan)
        self._stored = ImageStore(batch, (0, 0))
        self.use(intrinsics)

    def use(self, intrinsics: Intrinsics) -> None:
        """Switch to a camera; stored frames of another size are dropped."""
        self._frames = FrameFeatures(intrinsics)
        self._known: dict[int, Features] = {}  # of the last frames
        self._seen: dict[int, tuple[NDArray[np.uint8], Float32, Features]] = {}  # asked for since
        if self.images.depth.shape[1:] != intrinsics.shape:
            self._poses[:] = np.nan
            self._stored = ImageStore(len(self._poses), intrinsics.shape)

    def keep(self, images: Images, T_world_camera: Float64, known: NDArray[np.bool_]) -> None:
        """Store the images of the envs whose poses (B, 4, 4) are ``known`` (B,)."""
        self._stored.replace(images, known)
        self._poses[known] = T_world_camera[known]
        for env in [env for env in {**self._known, **self._seen} if known[env]]:
            self._known.pop(env, None)
            if env in self._seen and self._is_seen(env, *images.of(env)):
                self._known[env] = self._seen[env][-1]
        self._seen = {}

    @property
    def images(self) -> Images:
        """The frames."""
        return self._stored.images

    def move(self, env: int, T_world_camera: Float64) -> None:
        """Move an env's frame to another pose (4, 4)."""
        self._poses[env] = T_world_camera

    def forget(self, env: int) -> None:
        """Drop an env's frame."""
        self._poses[env] = np.nan
        self._known.pop(env, None)

    def get_state(self) -> dict[str, Any]:
        """The images and their poses."""
        images = self.images.on_host()
        own = {"color": images.color.copy(), "depth": images.depth.copy()}
        return own | super().get_state()

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return self.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state; features are sought anew."""
        super().set_state(state)
        everywhere = np.ones(len(self._poses), dtype=bool)
        self._stored.replace(Images(state["color"], state["depth"]), everywhere)
        self._known, self._seen = {}, {}

    def _is_seen(self, env: int, color: NDArray[np.uint8], depth: Float32) -> bool:
        """Whether the features sought last for an env are those of these images."""
        seen_color, seen_depth, _ = self._seen[env]
        return np.array_equal(seen_color, color) and np.array_equal(seen_depth, depth)

    def find(
        self, env: int, color: NDArray[np.uint8], depth: Float32, cutoff_m: float
    ) -> tuple[Float64, FeaturePose] | None:
        """Find T_world_camera (4, 4) of a frame (H, W) from features; None if they do not match."""
        if not np.isfinite(self._poses[env, 0, 0]):
            return None
        of = self._frames.features_of
        if env not in self._known:
            self._known[env] = of(*self.images.of(env), cutoff_m)
        if env not in self._seen or not self._is_seen(env, color, depth):
            self._seen[env] = color, depth, of(color, depth, cutoff_m)
        before, now = self._known[env], self._seen[env][-1]
        found = pose_from_features(before, now, self._frames.intrinsics)
        return None if found is None else (self._poses[env] @ found.T_reference_frame, found)
