"""Aligns a frame with a view of the model: the interface and its two variants."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.alignment_check import DepthImage
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.odometry import Aligner
from ms_slam_env.slam.volumetric.voxel_grid import CastView, VoxelGrid, camera_matrix

_ITERATIONS = (10, 5, 3)  # coarse to fine
_STOCK_ITERATIONS = (6, 3, 1)


class FrameToModel(ABC):
    """Finds the motion between the model's view and a frame."""

    @abstractmethod
    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """T_model_camera (4, 4) of a frame, searched from rest; None if there is none."""


class Open3DAlignment(FrameToModel):
    """Open3D's hybrid odometry, as in its dense SLAM: point to plane and photometric at once.

    Its sums over pixels are rounded differently in every run, even on one thread.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._rgbd_image = grid.open3d.t.geometry.RGBDImage
        self._odometry = grid.open3d.t.pipelines.odometry
        counts = _STOCK_ITERATIONS if grid.config.stock else _ITERATIONS
        self._criteria = [self._odometry.OdometryConvergenceCriteria(count) for count in counts]
        self._loss = self._odometry.OdometryLossParams(grid.config.association_m)
        self._start = grid.tensor(np.eye(4))

    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """T_model_camera (4, 4) of a frame against a view of the model, None if there is none."""
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
                self._odometry.Method.Hybrid,
                self._loss,
            )
        except RuntimeError:  # a singular system
            return None
        T = result.transformation.numpy()
        return np.array(T, dtype=np.float64) if np.isfinite(T).all() else None


class OpenCVAlignment(FrameToModel):
    """OpenCV's RGB-D odometry; the same result in every run."""

    def __init__(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        self._aligner = Aligner(intrinsics, depth_cutoff_m)

    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """T_model_camera (4, 4) of a frame against a view of the model, None if there is none."""
        model = self._aligner.prepare(DepthImage(view.depth, view.intensity))
        return self._aligner.align(self._aligner.prepare(frame), model)
