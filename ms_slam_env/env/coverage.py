# mypy: disable-error-code="empty-body"
"""Measure how much true surface has been mapped in its true place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.scenes.scene import Scene

STRIDE = 2
"""Every second pixel in each direction marks coverage."""

VOXEL_M = 0.05
"""Edge of a voxel."""

_SAMPLES_A_VOXEL = 2  # per edge: four points on each face, so that no voxel is missed


@dataclass(frozen=True)
class Voxels:
    """The voxels of a scene, computed once and shared.

    Attributes:
        origin: (3,) lower corner of the first voxel, metres.
        shape: (3,) number of voxels along each axis.
        reachable: (number of voxels,) whether a voxel contains surface adjacent to free space.
    """

    origin: Float64
    shape: tuple[int, ...]
    reachable: NDArray[np.bool_]

    @cached_property
    def num_reachable(self) -> int:
        """Number of reachable voxels."""
        return int(np.count_nonzero(self.reachable))

    @staticmethod
    def of(scene: Scene, voxel_m: float) -> Voxels:
        """The voxels of a scene, with edges of ``voxel_m`` metres."""
        known = _VOXELS.setdefault(scene, {})
        if voxel_m not in known:
            known[voxel_m] = _voxels(scene, voxel_m)
        return known[voxel_m]

    def index(self, points: Float64, voxel_m: float) -> NDArray[np.int64]:
        """Indices of the voxels of those points (N, 3) that lie in the grid."""
        cells = np.floor((points - self.origin) / voxel_m).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < np.array(self.shape)), axis=1)
        return np.ravel_multi_index(tuple(cells[inside].T), self.shape)


_VOXELS: WeakKeyDictionary[Scene, dict[float, Voxels]] = WeakKeyDictionary()


def _voxels(scene: Scene, voxel_m: float) -> Voxels:
    low, high = scene.bounds()
    origin = low - 2 * voxel_m
    shape = np.ceil((high + 2 * voxel_m - origin) / voxel_m).astype(np.int64) + 1
    voxels = Voxels(origin, tuple(shape.tolist()), np.zeros(int(np.prod(shape)), dtype=bool))
    surface, _ = scene.surface_points(voxel_m / _SAMPLES_A_VOXEL)
    voxels.reachable[voxels.index(surface, voxel_m)] = True
    return voxels


@wp.struct
class VoxelGrid:
    """A grid of voxels."""

    origin: wp.vec3d
    shape: wp.vec3i
    voxel_m: wp.float64


@wp.func_native(native_source("coverage", "mark_points"))
def mark_points(
    depth: wp.array[wp.float32],
    rays: wp.array[wp.float64],
    poses: wp.array[wp.mat44d],
    grid: VoxelGrid,
    reachable: wp.array[wp.uint8],
    mapped: wp.array[wp.uint8],
    counts: wp.array[wp.int32],
) -> None:
    """Launch ``mark_seen``."""


@wp.kernel
def mark_seen(
    depth: wp.array[wp.float32],  # (N,) metres; 0 = nothing
    rays: wp.array[wp.float64],  # (3 N,) points at depth 1 m
    poses: wp.array[wp.mat44d],  # (2,) true and estimated T_world_camera
    grid: VoxelGrid,
    reachable: wp.array[wp.uint8],  # (voxels,)
    mapped: wp.array[wp.uint8],  # (voxels,) in and out
    counts: wp.array[wp.int32],  # (2,) voxels mapped, and of those reachable; in and out
) -> None:
    """Mark the true voxels of points that the estimate puts within a voxel; single-threaded."""
    mark_points(depth, rays, poses, grid, reachable, mapped, counts)


class CoverageGrid:
    """Voxels of true surface that were mapped in their true place.

    A point counts as mapped when the estimated pose puts it less than one voxel from its true
    place. Neither a camera that stands still nor one that is lost gains more.

    Args:
        scene: gives the bounds.
        rays: (H, W, 3) points at depth 1 m of the camera's pixels.
        voxel_m: edge of a voxel, metres.
    """

    def __init__(self, scene: Scene, rays: Float64, voxel_m: float = VOXEL_M) -> None:
        self.voxel_m = voxel_m
        self._voxels = voxels = Voxels.of(scene, voxel_m)
        self._mapped = np.zeros(len(voxels.reachable), dtype=bool)
        self._counts = np.zeros(2, dtype=np.int32)  # mapped voxels, and the reachable among them
        marked_rays = np.ascontiguousarray(rays[::STRIDE, ::STRIDE], dtype=np.float64)
        self._depth = np.zeros(marked_rays.shape[:2], dtype=np.float32)
        self._poses = np.zeros((2, 4, 4))
        grid = VoxelGrid()
        grid.origin, grid.shape = wp.vec3d(*voxels.origin), wp.vec3i(*voxels.shape)
        grid.voxel_m = voxel_m
        seen = [_shared(self._depth.ravel(), wp.float32), _shared(marked_rays.ravel(), wp.float64)]
        marks = [voxels.reachable.view(np.uint8), self._mapped.view(np.uint8)]
        arrays = [*(_shared(mark, wp.uint8) for mark in marks), _shared(self._counts, wp.int32)]
        inputs = [*seen, _shared(self._poses, wp.mat44d), grid, *arrays]
        self._mark = RecordedLaunch(mark_seen, 1, inputs, "cpu")

    def see(
        self,
        depth: NDArray[np.float32],
        true_depth: NDArray[np.float32],
        T_world_camera: Float64,
        T_world_camera_estimate: Float64,
    ) -> float:
        """Mark the surface in a frame; return the area newly mapped in its true place, m2.

        The true depth is used wherever the sensor has a reading: depth noise would spread one
        surface over ever more voxels, and reward a camera at rest.

        Args:
            depth: (H, W) readings, 0 = none.
            true_depth: (H, W) metres.
            T_world_camera: (4, 4).
            T_world_camera_estimate: (4, 4).
        """
        every = slice(None, None, STRIDE)
        np.multiply(true_depth[every, every], depth[every, every] > 0, out=self._depth)
        self._poses[0], self._poses[1] = T_world_camera, T_world_camera_estimate
        before = int(self._counts[0])
        self._mark.launch()
        return (int(self._counts[0]) - before) * self.voxel_m**2

    @property
    def mapped_area(self) -> float:
        """Area mapped in its true place so far, square metres (one voxel face a voxel)."""
        return int(self._counts[0]) * self.voxel_m**2

    @property
    def mapped_share(self) -> float:
        """Share of the reachable surface mapped in its true place so far, [0, 1].

        Reachable surface is adjacent to free space (``Scene.surface_points``), counted in voxels.
        """
        return int(self._counts[1]) / max(1, self._voxels.num_reachable)

    def get_state(self) -> dict[str, Any]:
        """The marked voxels, packed."""
        return {"mapped": np.packbits(self._mapped)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Resume from a state that ``get_state`` returned."""
        self._mapped[:] = np.unpackbits(state["mapped"], count=self._mapped.size)
        reachable = np.count_nonzero(self._mapped & self._voxels.reachable)
        self._counts[:] = np.count_nonzero(self._mapped), reachable


def _shared(array: NDArray[Any], dtype: Any) -> wp.array:
    """Wrap an array for a kernel without copying."""
    return wp.array(array, dtype=dtype, device="cpu", copy=False)


def team_share(grids: Sequence[CoverageGrid]) -> float:
    """Share of a scene's reachable surface mapped by at least one of several robots, [0, 1]."""
    voxels = grids[0]._voxels
    mapped = np.logical_or.reduce([grid._mapped != 0 for grid in grids])
    return int(np.count_nonzero(mapped & voxels.reachable)) / max(1, voxels.num_reachable)
