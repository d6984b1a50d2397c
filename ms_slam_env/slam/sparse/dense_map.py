"""The depth of keyframes, merged into one surface that can be rendered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.geometry import relative_angle
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.sparse.config import SparseConfig
from ms_slam_env.slam.sparse.sparse_map import Keyframe
from ms_slam_env.slam.state import Saved
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam


class DenseMap(Saved):
    """Surfels fused from keyframes at their poses; made anew when a pose has changed."""

    saved = ("_surfels", "_poses", "_fused")

    def __init__(self, intrinsics: Intrinsics, config: SparseConfig) -> None:
        self._config = config
        self._surfels = SurfelSlam(
            intrinsics,
            SurfelConfig(
                depth_cutoff_m=config.depth_cutoff_m,
                max_surfels=config.max_surfels,
                unstable_window=100_000,  # keyframes are few, and each of them counts
            ),
        )
        self._poses: list[Float64] = []  # where each keyframe is in the map
        self._fused = 0  # how many of them are fused

    def clear(self) -> None:
        """Forget everything."""
        self._surfels.reset()
        self._poses = []
        self._fused = 0

    def place(self, keyframes: Sequence[Keyframe]) -> None:
        """Decide where these keyframes are in the map; nothing is fused before it is looked at."""
        pairs = zip(self._poses, keyframes, strict=False)
        if any(self._has_moved(placed, keyframe) for placed, keyframe in pairs):
            self.clear()
        for keyframe in keyframes[len(self._poses) :]:
            self._poses.append(keyframe.T_world_camera.copy())

    def updated(self, keyframes: Sequence[Keyframe]) -> SurfelSlam:
        """The surfels, once the keyframes that were placed are fused."""
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
        return moved_m > self._config.remap_m or turned > self._config.remap_deg
