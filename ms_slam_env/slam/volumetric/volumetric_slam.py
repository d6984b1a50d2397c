"""Volumetric SLAM with frame-to-model tracking, as a ``SlamBackend``.

KinectFusion (Newcombe et al., ISMAR 2011) as Open3D's ``t.pipelines.slam`` has it: the model is
cast from the last pose, the frame is aligned with that view, depth and intensity at once, and
fused. While tracking is lost the pose is held and nothing is fused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, invert
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
from ms_slam_env.slam.volumetric.alignment import FrameToModel, Open3DAlignment, OpenCVAlignment
from ms_slam_env.slam.volumetric.config import VolumetricConfig
from ms_slam_env.slam.volumetric.voxel_grid import DEPTH_SCALE, CastView, VoxelGrid

_FULL_WEIGHT = 3  # observations that tracking asks of the model, as soon as there are as many


class VolumetricSlam(SlamBackend):
    """The volumetric SLAM of one camera, through Open3D."""

    def __init__(self, intrinsics: Intrinsics, config: VolumetricConfig | None = None) -> None:
        """Start empty at the identity pose.

        Raises:
            InputError: Open3D, or a system library that it needs, is not installed.
        """
        self.intrinsics = intrinsics
        self.config = config or VolumetricConfig()
        self._thresholds = replace(
            VIEW_THRESHOLDS,
            overlap=self.config.least_overlap,
            inlier_ratio=self.config.least_inliers,
            photometric_inlier_ratio=self.config.least_alike,
        )
        self._grid = VoxelGrid(intrinsics, self.config)
        self._aligner: FrameToModel = (
            Open3DAlignment(self._grid)
            if self.config.aligner == "open3d"
            else OpenCVAlignment(intrinsics, self.config.depth_cutoff_m)
        )
        self._fresh = True  # whether the grid is as allocated
        self.reset()

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self._pose = np.array(check_pose(pose, "T_world_camera"))
        self._motion = np.eye(4)
        self._fused = 0
        self._lost = False
        self._view: CastView | None = None
        if not self._fresh:
            self._grid.clear()
            self._fresh = True

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and fuse it into the grid; see ``SlamBackend``.

        Where the last pose leads nowhere, the guess and poses around the last one are tried.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the guess is no pose.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        guess = None
        if T_world_camera_guess is not None:
            guess = np.array(check_pose(T_world_camera_guess, "T_world_camera_guess"))
        depth = self._depth(frame)
        enough = float((depth > 0).mean()) >= FEWEST_READINGS
        if not enough:
            which = "frame" if self._fused else "first frame"
            return self._lose(f"the {which} has too few depth readings", NO_ALIGNMENT)
        if self._fused == 0:
            return self.fuse(frame, self._pose)
        reason, statistics = "", NO_ALIGNMENT
        grey = intensity_image(frame.color).astype(np.float32)
        image = DepthImage((depth / np.float32(DEPTH_SCALE)).astype(np.float32), grey)
        for pose, view in self._views(image, guess):
            afar = view is not self._view
            thresholds = self._thresholds.tentative if afar else self._thresholds
            T, statistics, reason = self._align(image, pose, view, thresholds)
            if afar and not reason:
                T, statistics, reason = self._align(
                    image, T, self._cast(T), self._thresholds.confirmation
                )
            if not reason:
                return self._accept(frame, depth, T, statistics)
        return self._lose(reason, statistics)

    def _views(
        self, image: DepthImage, guess: Float64 | None
    ) -> Iterator[tuple[Float64, CastView]]:
        """Views to align ``image`` with and their poses, in the order in which they are tried."""
        if self._view is None:
            self._view = self._cast(self._pose)
        yield self._pose, self._view
        if guess is not None:
            yield guess, self._cast(guess)
        seen = DepthImage(self._view.depth, self._view.intensity)
        for motion in start_motions(image, seen, self._motion, self.intrinsics):
            pose = self._pose @ motion
            yield pose, self._cast(pose)

    def _accept(
        self,
        frame: RGBDFrame,
        depth: NDArray[np.uint16],
        T: Float64,
        statistics: AlignmentStatistics,
    ) -> TrackResult:
        """Move on to a frame whose pose T_world_camera was found."""
        relocalised, self._lost = self._lost, False
        self._motion = np.eye(4) if relocalised else invert(self._pose) @ T
        self._pose = T
        self._fuse(frame, depth)
        return TrackResult(
            T_world_camera=T.copy(),
            tracking_ok=True,
            relocalised=relocalised,
            inlier_fraction=statistics.inlier_ratio,
            residual_m=statistics.residual_m,
        )

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` into the grid at a known pose (4, 4), without tracking.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the pose is none.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        self._pose = np.array(check_pose(T_world_camera, "T_world_camera"))
        self._motion = np.eye(4)
        self._lost = False
        self._view = None
        depth = self._depth(frame)
        if (depth > 0).any():
            self._fuse(frame, depth)
        return TrackResult(self._pose.copy(), True)

    def _depth(self, frame: RGBDFrame) -> NDArray[np.uint16]:
        """Depth in units of 1 / DEPTH_SCALE m, 0 beyond the cutoff."""
        depth = np.where(frame.depth <= self.config.depth_cutoff_m, frame.depth, 0)
        return np.rint(depth * DEPTH_SCALE).astype(np.uint16)

    def _fuse(self, frame: RGBDFrame, depth: NDArray[np.uint16]) -> None:
        self._grid.fuse(depth, frame.color, self._pose)
        self._fresh = False
        self._fused += 1
        self._view = None

    def _cast(self, pose: Float64) -> CastView:
        """The view that frames are aligned with, cast from ``pose``."""
        weight = min(self._fused, _FULL_WEIGHT)
        return self._grid.cast(pose, weight, self.intrinsics)

    def _align(
        self, image: DepthImage, pose: Float64, view: CastView, thresholds: AcceptanceThresholds
    ) -> tuple[Float64, AlignmentStatistics, str]:
        """T_world_camera (4, 4), what it explains, and why it is not to be believed or nothing."""
        reference = DepthImage(view.depth, view.intensity)
        if reference.readings < FEWEST_READINGS:
            return pose, NO_ALIGNMENT, "too little of the model is in view"
        T_model_camera = self._aligner.align(image, view)
        if T_model_camera is None:
            return pose, NO_ALIGNMENT, "no motion aligns the frame with the model"
        statistics = measure_alignment(image, reference, T_model_camera, self.intrinsics)
        return (
            pose @ T_model_camera,
            statistics,
            VIEW_REASONS[evaluate_alignment(statistics, thresholds)],
        )

    def _lose(self, reason: str, statistics: AlignmentStatistics) -> TrackResult:
        """Hold the pose."""
        self._motion = np.eye(4)
        self._lost = self._fused > 0
        return TrackResult(
            T_world_camera=self._pose.copy(),
            tracking_ok=False,
            inlier_fraction=statistics.inlier_ratio,
            residual_m=statistics.residual_m,
            reason=reason,
        )

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Cast the grid from ``poses`` (N, 4, 4) T_world_camera at ``scale`` times the size.

        Raises:
            InputError: poses of another shape, or a scale outside (0, 1].
        """
        stack = np.asarray(poses, dtype=np.float64)
        if stack.ndim != 3 or stack.shape[1:] != (4, 4) or len(stack) == 0:
            raise InputError(f"poses must have shape (N, 4, 4), got {stack.shape}")
        if not 0 < scale <= 1:
            raise InputError(f"scale = {scale} is outside (0, 1]")
        intrinsics = self.intrinsics.scaled(scale)
        weight = self.config.least_weight
        views = [self._grid.cast(pose, weight, intrinsics) for pose in stack]
        return Views(
            intensity=np.stack([view.intensity for view in views]),
            depth=np.stack([view.depth for view in views]),
            normals=np.stack([view.normals for view in views]),
            intrinsics=intrinsics,
        )

    def surface_points(self) -> Float64:
        """Points (M, 3) where the signed distance crosses zero, world frame."""
        return self._grid.surface()[0]

    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``."""
        return self._grid.surface()[1]

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Colour and normal of ``surface_points``."""
        _, colors, normals = self._grid.surface()
        return {"color": colors, "normal": normals}

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return {
            "pose": self._pose.copy(),
            "motion": self._motion.copy(),
            "fused": self._fused,
            "lost": self._lost,
            "grid": self._grid.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of a SLAM of the same intrinsics and configuration."""
        self._pose = state["pose"].copy()
        self._motion = state["motion"].copy()
        self._fused = state["fused"]
        self._lost = state["lost"]
        self._grid.set_state(state["grid"])
        self._fresh = False
        self._view = None
