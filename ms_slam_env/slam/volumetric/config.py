"""Parameters of the volumetric SLAM."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import check_choice, check_range


@dataclass(frozen=True)
class VolumetricConfig:
    """Parameters of tracking and of the voxel grid.

    Attributes:
        voxel_m: size of a voxel.
        block_voxels: voxels along an edge of a block; blocks are allocated near surfaces.
        blocks: blocks allocated at the start; the grid grows when they are used up.
        truncation_voxels: the signed distance is cut off at this many voxels.
        depth_cutoff_m: readings beyond are ignored.
        aligner: what aligns a frame with the model's view: ``opencv`` (the same result in every
            run) or ``open3d`` (what Open3D's dense SLAM has; runs differ in the last digits of
            every pose, and then by millimetres).
        association_m: largest difference of depth between associated points, ``open3d`` only.
        least_weight: observations after which a voxel counts as surface, in predictions and in
            the surface points.
        least_overlap: share of a frame's readings that the model's view must show,
        least_inliers: share of those that must fit its depth,
        least_alike: share of those that must fit its intensity.

    Raises:
        InputError: a value outside its range.
    """

    voxel_m: float = 0.015
    block_voxels: int = 8
    blocks: int = 4_000
    truncation_voxels: float = 4.0
    depth_cutoff_m: float = 4.0
    aligner: str = "opencv"
    association_m: float = 0.07
    least_weight: int = 1
    least_overlap: float = 0.3
    least_inliers: float = 0.75
    least_alike: float = 0.9

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "voxel_m", 0.001, 0.2)
        check_range(self, "block_voxels", 4, 32)
        check_range(self, "blocks", 100, 10_000_000)
        check_range(self, "truncation_voxels", 1.0, 50.0)
        check_range(self, "depth_cutoff_m", 0.1, 10.0)
        check_choice(self, "aligner", ("opencv", "open3d"))
        check_range(self, "association_m", 0.001, 1.0)
        check_range(self, "least_weight", 1, 1000)
        check_range(self, "least_overlap", 0.0, 1.0)
        check_range(self, "least_inliers", 0.0, 1.0)
        check_range(self, "least_alike", 0.0, 1.0)
