"""The volumetric SLAM backend, with frame-to-model tracking.

KinectFusion (Newcombe et al., ISMAR 2011) in the variant of Open3D's ``t.pipelines.slam``: the
model is ray-cast from the last pose, the frame is aligned with that view by depth and intensity
together, and fused. While tracking is lost the pose is held and nothing is fused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.errors import InputError
from ms_slam_env.slam.odometry.odometry import Aligner
from ms_slam_env.slam.shared.alignment_check import (
    FEWEST_READINGS,
    NO_ALIGNMENT,
    AcceptanceThresholds,
)
from ms_slam_env.slam.shared.alignment_measures import DepthImage, check_alignment
from ms_slam_env.slam.shared.tracking_template import Attempt, FrameByFrameSlam, motion_hypotheses
from ms_slam_env.slam.slam_backend import Views, check_views
from ms_slam_env.slam.volumetric.voxel_grid import (
    DEPTH_SCALE,
    CastView,
    Open3DConfig,
    StockVoxelGrid,
    VolumetricConfig,
    VoxelGrid,
    camera_matrix,
)

_ITERATIONS = (10, 5, 3)  # coarse to fine
_ASSOCIATION_M = 0.07  # largest difference of depth between associated points
_STOCK_ITERATIONS = (6, 3, 1)


class FrameToModel(ABC):
    """Finds the motion between the model's view and a frame."""

    @abstractmethod
    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """Align a frame with a view, starting at rest; return T_model_camera (4, 4) or None."""


class Open3DAlignment(FrameToModel):
    """Open3D's odometry: point-to-plane, as in its dense SLAM, or point-to-plane plus photometric.

    On several cores its sums over pixels are rounded differently in every run.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._rgbd_image = grid.open3d.t.geometry.RGBDImage
        self._odometry = grid.open3d.t.pipelines.odometry
        counts = _STOCK_ITERATIONS if grid.config.stock else _ITERATIONS
        self._criteria = [self._odometry.OdometryConvergenceCriteria(count) for count in counts]
        self._loss = self._odometry.OdometryLossParams(_ASSOCIATION_M)
        self._start = grid.tensor(np.eye(4))
        methods = self._odometry.Method
        self._method = methods.Hybrid if grid.config.aligner == "open3d" else methods.PointToPlane

    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """Align a frame with a view of the model; return T_model_camera (4, 4) or None."""
        grid = self._grid
        grey = np.repeat(frame.intensity[..., None] / np.float32(255), 3, axis=2)
        source = self._rgbd_image(grid.image(grey), grid.image(frame.depth))
        target = self._rgbd_image(grid.image(view.color), grid.image(view.depth))
        try:
            result = self._odometry.rgbd_odometry_multi_scale(
                source,
                target,
                camera_matrix(grid, grid.intrinsics),
                self._start,
                1.0,
                grid.config.depth_cutoff_m,
                self._criteria,
                self._method,
                self._loss,
            )
        except RuntimeError:  # a singular system
            return None
        T = result.transformation.numpy()
        return np.array(T, dtype=np.float64) if np.isfinite(T).all() else None


class OpenCVAlignment(FrameToModel):
    """OpenCV's RGB-D odometry; deterministic."""

    def __init__(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        self._aligner = Aligner(intrinsics, depth_cutoff_m)

    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """Align a frame with a view of the model; return T_model_camera (4, 4) or None."""
        model = self._aligner.prepare(DepthImage(view.depth, view.intensity))
        return self._aligner.align(self._aligner.prepare(frame), model)


_FULL_WEIGHT = 3  # observations that tracking requires once that many frames are fused
_STOCK_FULL_WEIGHT = 4  # Open3D requires more than 3


@dataclass(frozen=True)
class FusedImage(DepthImage):
    """A frame without depth beyond the cutoff."""

    raw_depth: NDArray[np.uint16]  # (H, W) in units of 1 / DEPTH_SCALE m
    color: NDArray[np.uint8]  # (H, W, 3)


class VolumetricSlam(FrameByFrameSlam[FusedImage, None]):
    """The volumetric SLAM of one camera, with Open3D."""

    saved = (*FrameByFrameSlam.saved, "_fused", "_grid")
    config: Any

    def __init__(self, intrinsics: Intrinsics, config: VolumetricConfig | None = None) -> None:
        """Start empty at the identity pose."""
        self.config = config or VolumetricConfig()
        in_force = self.config.in_force
        grid = (StockVoxelGrid if in_force.stock else VoxelGrid)(intrinsics, in_force)
        is_open3d = in_force.aligner != "opencv"
        cutoff_m = in_force.depth_cutoff_m
        self._assemble(
            grid, Open3DAlignment(grid) if is_open3d else OpenCVAlignment(intrinsics, cutoff_m)
        )

    def _assemble(self, grid: VoxelGrid, aligner: FrameToModel) -> None:
        """Start empty at the identity pose, with these parts and the settings of ``config``."""
        self._grid, self._aligner = grid, aligner
        self._judge_views(self._accepts_all)
        self._fresh = True  # whether the grid is as allocated
        super().__init__(grid.intrinsics)

    @property
    def _accepts_all(self) -> bool:
        """Whether every motion that is found is accepted, and no other pose is tried."""
        return bool(self.config.stock)

    @property
    def _has_map(self) -> bool:
        return self._fused > 0

    @property
    def _no_attempt(self) -> str:
        return ""

    def _clear(self) -> None:
        self._fused = 0
        self._view: CastView | None = None
        if not self._fresh:
            self._grid.clear()
            self._fresh = True

    def _prepare(self, frame: RGBDFrame) -> FusedImage:
        depth = np.where(frame.depth <= self.config.depth_cutoff_m, frame.depth, 0)
        raw = np.rint(depth * DEPTH_SCALE).astype(np.uint16)
        grey = intensity_image(frame.color).astype(np.float32)
        metres = (raw / np.float32(DEPTH_SCALE)).astype(np.float32)
        return FusedImage(metres, grey, raw, frame.color)

    def _attempts(self, prepared: FusedImage, guess: Float64 | None) -> Iterator[Attempt[None]]:
        if self._view is None:
            self._view = self._cast(self._pose)
        yield self._align(prepared, self._pose, self._view, self._thresholds)
        if self._accepts_all:
            return
        if guess is not None:
            yield self._confirmed(prepared, guess)
        if not self._searches:
            return
        seen = DepthImage(self._view.depth, self._view.intensity)
        for motion in motion_hypotheses(prepared, seen, self._motion, self.intrinsics):
            yield self._confirmed(prepared, self._pose @ motion)

    def _confirmed(self, image: FusedImage, pose: Float64) -> Attempt[None]:
        """Align with the view from a pose; if plausible, align again with that from the result."""
        attempt = self._align(image, pose, self._cast(pose), self._thresholds.tentative)
        if attempt.reason:
            return attempt
        closer = attempt.T_world_camera
        return self._align(image, closer, self._cast(closer), self._thresholds.confirmation)

    def _align(
        self, image: FusedImage, pose: Float64, view: CastView, thresholds: AcceptanceThresholds
    ) -> Attempt[None]:
        reference = DepthImage(view.depth, view.intensity)
        if reference.readings < self.fewest_readings:
            return Attempt(pose, NO_ALIGNMENT, "too little of the model is in view", None)
        T_model_camera = self._aligner.align(image, view)
        if T_model_camera is None:
            return Attempt(pose, NO_ALIGNMENT, "no motion aligns the frame with the model", None)
        motion = T_model_camera, self.intrinsics
        found, *refused = check_alignment(image, reference, *motion, thresholds)
        return Attempt(pose @ T_model_camera, found, refused[0], None, refused[1])

    def _cast(self, pose: Float64) -> CastView:
        """The view that frames are aligned with, cast from ``pose``."""
        weight = min(self._fused, _STOCK_FULL_WEIGHT if self.config.stock else _FULL_WEIGHT)
        return self._grid.cast(pose, weight, self.intrinsics)

    def _start_from(self, frame: RGBDFrame, prepared: FusedImage) -> None:
        self._view = None
        if prepared.raw_depth.any():
            self._fuse(prepared)

    def _extend(self, frame: RGBDFrame, prepared: FusedImage, attempt: Attempt[None]) -> None:
        self._fuse(prepared)

    def _miss(self, frame: RGBDFrame, prepared: FusedImage) -> None:
        if self.config.stock:
            self._fuse(prepared)

    def _fuse(self, image: FusedImage) -> None:
        self._grid.fuse(image.raw_depth, image.color, self._pose)
        self._fresh = False
        self._fused += 1
        self._view = None

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Cast the grid from ``poses`` (N, 4, 4) T_world_camera at ``scale`` times the size."""
        stack = check_views(poses, scale)
        if len(stack) == 0:
            raise InputError(f"poses must have shape (N, 4, 4), got {stack.shape}")
        intrinsics = self.intrinsics.scaled(scale)
        weight = self._grid.config.least_weight
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

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state of a backend with the same intrinsics and configuration."""
        super().set_state(state)
        self._fresh = False
        self._view = None


class Open3DSlam(VolumetricSlam):
    """Open3D's dense SLAM with its best parameters; accepts every motion that Open3D returns."""

    def __init__(self, intrinsics: Intrinsics, config: Open3DConfig | None = None) -> None:
        """Start empty at the identity pose."""
        super().__init__(intrinsics, config or Open3DConfig())
        if not self.config.stock:
            self.fewest_readings = FEWEST_READINGS

    @property
    def _accepts_all(self) -> bool:
        return True
