"""How much true surface has been mapped where it really is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import transform_points
from ms_slam_env.scenes.base import Scene

Float64 = NDArray[np.float64]

_STRIDE = 2  # every second pixel in each direction marks coverage


_SAMPLES_A_VOXEL = 2  # along an edge: four points on each face, so that none is missed


@dataclass(frozen=True)
class Voxels:
    """The voxels of a scene; worked out once and shared.

    Attributes:
        origin: (3,) lower corner of the first, metres.
        shape: (3,) how many along each axis.
        reachable: (number of voxels,) whether there is surface in it that opens into free space.
    """

    origin: Float64
    shape: tuple[int, ...]
    reachable: NDArray[np.bool_]

    @cached_property
    def num_reachable(self) -> int:
        """How many are reachable."""
        return int(np.count_nonzero(self.reachable))

    @staticmethod
    def of(scene: Scene, voxel_m: float) -> Voxels:
        """The voxels of a scene, with an edge in metres."""
        known = _VOXELS.setdefault(scene, {})
        if voxel_m not in known:
            known[voxel_m] = _voxels(scene, voxel_m)
        return known[voxel_m]

    def index(self, points: Float64, voxel_m: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Voxels of the points (N, 3) that lie in the grid, and which do (N,)."""
        cells = np.floor((points - self.origin) / voxel_m).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < np.array(self.shape)), axis=1)
        return np.ravel_multi_index(tuple(cells[inside].T), self.shape), inside


_VOXELS: WeakKeyDictionary[Scene, dict[float, Voxels]] = WeakKeyDictionary()


def _voxels(scene: Scene, voxel_m: float) -> Voxels:
    low, high = scene.bounds()
    origin = low - 2 * voxel_m
    shape = np.ceil((high + 2 * voxel_m - origin) / voxel_m).astype(np.int64) + 1
    voxels = Voxels(origin, tuple(shape.tolist()), np.zeros(int(np.prod(shape)), dtype=bool))
    surface, _ = scene.surface_points(voxel_m / _SAMPLES_A_VOXEL)
    voxels.reachable[voxels.index(surface, voxel_m)[0]] = True
    return voxels


class CoverageGrid:
    """Voxels of true surface that were mapped in their true place.

    A point counts as mapped when the estimated pose puts it less than one voxel from where it is:
    neither a camera that stands still nor one that is lost gathers more.

    Args:
        scene: gives the bounds.
        voxel_m: edge of a voxel, metres.
    """

    def __init__(self, scene: Scene, voxel_m: float = 0.05) -> None:
        self.voxel_m = voxel_m
        self._voxels = Voxels.of(scene, voxel_m)
        self._mapped = np.zeros(len(self._voxels.reachable), dtype=bool)

    def add(self, points_true: Float64, points_estimated: Float64) -> float:
        """Mark points (N, 3); return the area newly mapped in its true place, square metres."""
        flat, inside = self._voxels.index(points_true, self.voxel_m)
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
        return int(np.count_nonzero(self._mapped)) * self.voxel_m**2

    @property
    def mapped_share(self) -> float:
        """Share of the reachable surface that was mapped in its true place so far, [0, 1].

        Reachable is what opens into free space (``Scene.surface_points``), counted in voxels.
        """
        mapped = np.count_nonzero(self._mapped & self._voxels.reachable)
        return mapped / max(1, self._voxels.num_reachable)

    def get_state(self) -> dict[str, Any]:
        """The marked voxels, packed."""
        return {"mapped": np.packbits(self._mapped)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        size = self._mapped.size
        self._mapped = np.unpackbits(state["mapped"], count=size).astype(bool)
