"""KinectFusion with its own parameters, on the voxel grid of the volumetric SLAM.

Newcombe et al. (ISMAR 2011). Parameter names and defaults are those of SLAMBench (Nardi et al.,
ICRA 2015), whose design space was the first that the paper's authors searched. It uses geometry
only: filter depth, align with the model's view, check, fuse, ray-cast the model again.

As in the other backends, there is one more check, and other initial poses are tried if it fails;
``stock`` disables both. Two differences from the original: voxels are allocated only near surfaces
(Open3D), and their weights grow without bound instead of up to 100. ``compute_size_ratio`` and
``tracking_rate`` of that space are the configuration's ``image_size`` and ``keep_every``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import Checked, bounded, check_counts
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.slam.shared.alignment_measures import DepthImage
from ms_slam_env.slam.shared.tracking_template import Attempt
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M
from ms_slam_env.slam.volumetric.projective_icp import (
    ProjectiveICP,
    Surface,
    frame_pyramid,
    model_surface,
)
from ms_slam_env.slam.volumetric.volumetric_slam import FrameToModel, FusedImage, VolumetricSlam
from ms_slam_env.slam.volumetric.voxel_grid import CastView, VolumetricConfig, VoxelGrid

_COS_ANGLE = 0.8  # least cosine between the normals of corresponding points
_LEAST_SHARE = 0.15  # share of all pixels that must correspond; with fewer, tracking is lost
_EVERY_FRAME = 4  # first frames are fused whatever the rate, as in SLAMBench


@dataclass(frozen=True)
class KinectFusionConfig(Checked):
    """Parameters of KinectFusion; ranges are the published search ranges where available.

    Attributes:
        volume_size_m: edge of the mapped cube; readings outside are not fused.
        volume_resolution: voxels along that edge.
        mu_m: truncation of the signed distance; clipped to between 1 and 50 voxels.
        icp_threshold: step length (metres and radians) below which an ICP level ends.
        iterations: most ICP iterations per pyramid level, finest first.
        integration_rate: every n-th tracked frame is fused.
        icp_distance_m: largest distance of corresponding points.
        track_residual_m: tracking is lost if their RMS distance from the model is larger.
        start_x: x (right) of the first camera in the cube, as a share of its edge.
        start_y: y (down) of the first camera, as a share.
        start_z: z (forward) of the first camera, as a share. SLAMBench maps 4.8 m in 256 voxels
            with the first camera at a side of the cube (0.5, 0.5, 0), so only what lies ahead. Here
            the camera may turn.
        depth_cutoff_m: readings beyond are ignored.
        least_weight: observations that a voxel needs to count as surface in predictions and surface
            points.
        stock: as published: only SLAMBench's two rules decide, intensity is not used, and only the
            last pose is tried.
    """

    volume_size_m: float = bounded(8.0, 1.0, 20.0)
    volume_resolution: int = bounded(512, 64, 1024)
    mu_m: float = bounded(0.1, 0.001, 0.5)
    icp_threshold: float = bounded(1e-5, 1e-6, 1e2)
    iterations: tuple[int, ...] = (10, 5, 4)
    integration_rate: int = bounded(1, 1, 30)
    icp_distance_m: float = bounded(0.1, 0.01, 1.0)
    track_residual_m: float = bounded(0.02, 0.001, 1.0)
    start_x: float = bounded(0.5, 0.0, 1.0)
    start_y: float = bounded(0.5, 0.0, 1.0)
    start_z: float = bounded(0.5, 0.0, 1.0)
    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    least_weight: int = bounded(1, 1, 1000)
    stock: bool = False

    def __post_init__(self) -> None:
        """Refuse invalid counts."""
        super().__post_init__()
        check_counts(self, "iterations", 5, 100)

    @property
    def grid(self) -> VolumetricConfig:
        """Parameters of the voxel grid."""
        voxel_m = self.volume_size_m / self.volume_resolution
        return VolumetricConfig(
            voxel_m=float(np.clip(voxel_m, 0.001, 0.2)),
            truncation_voxels=float(np.clip(self.mu_m / voxel_m, 1.0, 50.0)),
            depth_cutoff_m=self.depth_cutoff_m,
            least_weight=self.least_weight,
        )


class ProjectiveAlignment(FrameToModel):
    """ICP against the model's view, with SLAMBench's check of the result."""

    def __init__(self, intrinsics: Intrinsics, config: KinectFusionConfig) -> None:
        self._intrinsics, self._config = intrinsics, config
        gates = config.icp_distance_m, _COS_ANGLE
        self._icp = ProjectiveICP(intrinsics, config.iterations, config.icp_threshold, *gates)
        self._frame: DepthImage | None = None
        self._pyramid: list[Surface] = []

    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """Align a frame with a view of the model; return T_model_camera (4, 4) or None."""
        if frame is not self._frame:
            levels = len(self._config.iterations)
            self._frame, self._pyramid = frame, frame_pyramid(frame.depth, self._intrinsics, levels)
        T, sums = self._icp.align(self._pyramid, model_surface(view, self._intrinsics))
        share = sums.inliers / frame.depth.size
        is_far = sums.residual_m > self._config.track_residual_m
        return None if share < _LEAST_SHARE or is_far else T


class KinectFusionSlam(VolumetricSlam):
    """KinectFusion of one camera."""

    saved = (*VolumetricSlam.saved, "_T_world_start", "_tracked")

    def __init__(self, intrinsics: Intrinsics, config: KinectFusionConfig | None = None) -> None:
        """Start empty at the identity pose."""
        self.config = config or KinectFusionConfig()
        self._rays = intrinsics.rays()
        grid = VoxelGrid(intrinsics, self.config.grid)
        self._assemble(grid, ProjectiveAlignment(intrinsics, self.config))

    def _clear(self) -> None:
        super()._clear()
        self._T_world_start = self._pose.copy()
        self._tracked = 0

    def _start_from(self, frame: RGBDFrame, prepared: FusedImage) -> None:
        if self._fused == 0:
            self._T_world_start = self._pose.copy()
        super()._start_from(frame, prepared)

    def _extend(self, frame: RGBDFrame, prepared: FusedImage, attempt: Attempt[None]) -> None:
        self._view = None  # outdated: the camera has moved
        self._tracked += 1
        if self._tracked % self.config.integration_rate == 0 or self._tracked < _EVERY_FRAME:
            self._fuse(prepared)

    def _miss(self, frame: RGBDFrame, prepared: FusedImage) -> None:
        """A lost frame is never fused."""

    def _fuse(self, image: FusedImage) -> None:
        """Fuse the readings in the volume."""
        c = self.config
        T_start_camera = invert(self._T_world_start) @ self._pose
        points = transform_points(T_start_camera, self._rays * image.depth[..., None])
        share = points / c.volume_size_m + (c.start_x, c.start_y, c.start_z)
        inside = ((share >= 0) & (share <= 1)).all(axis=-1)
        super()._fuse(replace(image, raw_depth=image.raw_depth * inside))
