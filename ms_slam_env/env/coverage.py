"""How much true surface has been mapped where it really is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import transform_points
from ms_slam_env.scenes.base import Scene

Float64 = NDArray[np.float64]

_STRIDE = 2  # every second pixel in each direction marks coverage


class CoverageGrid:
    """Voxels of true surface that were mapped in their true place.

    A point counts as mapped when the estimated pose puts it less than one voxel from where it is:
    neither a camera that stands still nor one that is lost gathers more.

    Args:
        scene: gives the bounds.
        voxel_m: edge of a voxel, metres.
    """

    def __init__(self, scene: Scene, voxel_m: float = 0.05) -> None:
        margin = 2 * voxel_m
        self.voxel_m = voxel_m
        low, high = scene.bounds()
        self._origin = low - margin
        extent = high + margin - self._origin
        self._shape = np.ceil(extent / voxel_m).astype(np.int64) + 1
        self._mapped = np.zeros(int(np.prod(self._shape)), dtype=bool)

    def add(self, points_true: Float64, points_estimated: Float64) -> float:
        """Mark points (N, 3); return the area newly mapped in its true place, square metres."""
        cells = np.floor((points_true - self._origin) / self.voxel_m).astype(np.int64)
        inside = ((cells >= 0) & (cells < self._shape)).all(axis=1)
        flat = np.ravel_multi_index(tuple(cells[inside].T), tuple(self._shape))
        error = np.linalg.norm(points_estimated - points_true, axis=1)[inside]
        correct = flat[error < self.voxel_m]
        new = np.unique(correct[~self._mapped[correct]])
        self._mapped[new] = True
        return len(new) * self.voxel_m**2

    def see(
        self,
        depth: NDArray[np.float32],
        true_depth: NDArray[np.float32],
        rays: Float64,
        T_world_camera: Float64,
        T_world_camera_estimate: Float64,
    ) -> float:
        """Mark what a frame shows; return the area newly mapped in its true place, square metres.

        Where the sensor has a reading the true depth counts: noise in depth would spread one
        surface over ever more voxels, and a camera at rest would be paid for it.

        Args:
            depth: (H, W) readings, 0 = none.
            true_depth: (H, W) metres.
            rays: (H, W, 3) points at depth 1 m.
            T_world_camera: (4, 4).
            T_world_camera_estimate: (4, 4).
        """
        every = slice(None, None, _STRIDE)
        valid = np.where(depth > 0, true_depth, 0)[every, every]
        seen = valid > 0
        points = rays[every, every][seen] * valid[seen][:, None]
        return self.add(
            transform_points(T_world_camera, points),
            transform_points(T_world_camera_estimate, points),
        )

    @property
    def mapped_area(self) -> float:
        """Area mapped in its true place so far, square metres (one voxel face a voxel)."""
        return int(self._mapped.sum()) * self.voxel_m**2

    def get_state(self) -> dict[str, Any]:
        """The marked voxels, packed."""
        return {"mapped": np.packbits(self._mapped)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        size = self._mapped.size
        self._mapped = np.unpackbits(state["mapped"], count=size).astype(bool)
