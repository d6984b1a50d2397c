"""An occupancy grid that follows its frames when closed loops and joined submaps move them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.mapping.occupancy_grid import OccupancyGrid
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.submaps import Submaps

Float64 = NDArray[np.float64]


class _Carved(NamedTuple):
    """A frame and where it was carved."""

    number: int  # as SLAM counts
    depth: NDArray[np.float32]
    T_world_camera: Float64


class OccupancyMap:
    """Keeps the frames that it was carved from, and carves anew what SLAM has moved.

    ``grid`` holds the frames of the present submap and of those joined to it: where another lies is
    a guess, and what it saw would be carved in the wrong place.

    Args:
        cell_m: edge of a cell, metres.
        reach_m: depth up to which a ray carves and strikes, metres.
    """

    def __init__(self, cell_m: float = 0.1, reach_m: float = 3.5) -> None:
        self.cell_m, self.reach_m = cell_m, reach_m
        self.grid = OccupancyGrid(cell_m, reach_m)
        self._frames: list[_Carved] = []
        self._in_grid: set[int] = set()

    def add(
        self,
        slam: SlamBackend,
        depth: NDArray[np.float32],
        T_world_camera: Float64,
        intrinsics: Intrinsics,
    ) -> None:
        """Take the frame (H, W), metres, that ``slam`` tracked last, at its pose (4, 4)."""
        number = slam.frames_counted - 1 if slam.frames_counted else len(self._frames)
        moved = self._follow(slam)
        self._frames.append(_Carved(number, depth, T_world_camera))
        present = _of_present_submap(slam.submaps(), [frame.number for frame in self._frames])
        if moved or self._in_grid | {number} != present:
            self.grid = OccupancyGrid(self.cell_m, self.reach_m)
            self._in_grid = set()
        missing = present - self._in_grid
        for frame in self._frames if len(missing) > 1 else self._frames[-1:]:
            if frame.number in missing:
                self.grid.integrate(frame.depth, frame.T_world_camera, intrinsics)
        self._in_grid = present

    def _follow(self, slam: SlamBackend) -> bool:
        """Put the frames where SLAM has them now; whether one in the grid has moved by that."""
        numbers, poses = slam.corrected_trajectory()
        now = dict(zip(numbers.tolist(), poses, strict=True))
        moved = False
        for index, frame in enumerate(self._frames):
            pose = now.get(frame.number)
            if pose is None:
                continue
            # Each entry of the rotation tells how far the depths along an axis have turned.
            apart = np.abs(pose - frame.T_world_camera)[:3] @ [*[self.reach_m] * 3, 1.0]
            if apart.max() > 0.5 * self.cell_m:
                self._frames[index] = frame._replace(T_world_camera=pose)
                moved |= frame.number in self._in_grid
        return moved


def _of_present_submap(submaps: Submaps, numbers: list[int]) -> set[int]:
    """Which of the frames belong to the submap of the last one, or to one that it is joined to."""
    roots = submaps.joined_to[np.searchsorted(submaps.first_frames, numbers, side="right") - 1]
    return {number for number, root in zip(numbers, roots, strict=True) if root == roots[-1]}
