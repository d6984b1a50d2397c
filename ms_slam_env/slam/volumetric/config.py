"""Parameters of the volumetric SLAM."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from ms_slam_env.config import Checked, bounded, chosen

STOCK: dict[str, Any] = {
    "voxel_m": 0.01,
    "block_voxels": 16,
    "blocks": 40_000,
    "truncation_voxels": 8.0,
    "aligner": "open3d",
    "association_m": 0.07,
}
"""Of Open3D's example; more iterations, a narrower truncation or association do not lower the error
with noise."""


@dataclass(frozen=True)
class VolumetricConfig(Checked):
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
        stock: Open3D's dense SLAM as it is, with the parameters of its own example
            ``dense_slam.py`` but for ``depth_cutoff_m`` and voxels of 1 cm, whatever the others
            say: nothing is checked, no other pose is tried, and a frame that cannot be aligned is
            fused where the camera was last.
    """

    voxel_m: float = bounded(0.015, 0.001, 0.2)
    block_voxels: int = bounded(8, 4, 32)
    blocks: int = bounded(4_000, 100, 10_000_000)
    truncation_voxels: float = bounded(4.0, 1.0, 50.0)
    depth_cutoff_m: float = bounded(4.0, 0.1, 10.0)
    aligner: str = chosen("opencv", "opencv", "open3d")
    association_m: float = bounded(0.07, 0.001, 1.0)
    least_weight: int = bounded(1, 1, 1000)
    least_overlap: float = bounded(0.3, 0.0, 1.0)
    least_inliers: float = bounded(0.75, 0.0, 1.0)
    least_alike: float = bounded(0.9, 0.0, 1.0)
    stock: bool = False

    @property
    def in_force(self) -> VolumetricConfig:
        """The parameters that are used."""
        return replace(self, **STOCK) if self.stock else self
