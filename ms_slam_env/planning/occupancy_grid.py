"""Occupancy grids: carved from depth, carved again when SLAM moves frames, sampled by a camera."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float32, Float64, Int64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import transform_points
from ms_slam_env.planning.kernels import BLANK, PASSED, STRUCK, count_states, mark_rays
from ms_slam_env.slam.shared.submap_frames import Submaps

UNKNOWN, FREE, OCCUPIED = 0, 1, 2

FAR_M = 0.5
"""Largest distance to a surface that a grid reports."""

_CHANGE = np.array([0, -1, 3, 0], dtype=np.int8)  # of the log-odds, by mark
_LIMIT = 9  # of the log-odds: even an old error is corrected within as many frames
_PAD = 16  # extra cells by which the arrays grow, so that they are seldom copied


class OccupancyGrid:
    """Occupancy of cells; the grid grows with the space seen.

    Args:
        cell_m: edge of a cell, metres.
        reach_m: depth up to which a ray marks free and occupied cells, metres.
    """

    def __init__(self, cell_m: float = 0.1, reach_m: float = 3.5) -> None:
        self.cell_m = cell_m
        self.reach_m = reach_m
        self.first: Int64 = np.zeros(3, dtype=np.int64)
        """(3,) index of the arrays' first cell, relative to the cell that begins at the origin."""
        self.log_odds: NDArray[np.int8] = np.zeros((0, 0, 0), dtype=np.int8)
        """(X, Y, Z) log-odds: above 0 occupied, below 0 free, 0 unknown."""
        self.blanks: NDArray[np.int8] = np.zeros((0, 0, 0), dtype=np.int8)
        """(X, Y, Z) number of frames (at most 100) with only readingless rays through a cell."""

    def copy(self) -> OccupancyGrid:
        """An independent copy."""
        other = OccupancyGrid(self.cell_m, self.reach_m)
        other.first = self.first.copy()
        other.log_odds, other.blanks = self.log_odds.copy(), self.blanks.copy()
        return other

    def cells_of(self, points: Float64) -> Int64:
        """Indices into the arrays (..., 3) of points (..., 3), metres; they may lie outside."""
        return np.floor(points / self.cell_m).astype(np.int64) - self.first

    def centres_of(self, cells: Int64) -> Float64:
        """Centres (..., 3), metres, of cells given by their indices into the arrays (..., 3)."""
        return np.asarray((cells + self.first + 0.5) * self.cell_m, dtype=np.float64)

    def states_of(self, points: Float64) -> NDArray[np.int8]:
        """``UNKNOWN``, ``FREE`` or ``OCCUPIED`` (N,) at points (N, 3), metres."""
        cells = self.cells_of(points)
        inside = ((cells >= 0) & (cells < self.log_odds.shape)).all(axis=-1)
        states = np.full(len(points), UNKNOWN, dtype=np.int8)
        value = self.log_odds[tuple(cells[inside].T)]
        states[inside] = np.where(value > 0, OCCUPIED, np.where(value < 0, FREE, UNKNOWN))
        return states

    def clearance(self, points: Float64) -> Float64:
        """Distance (N,) from points (N, 3) to the middle of the nearest occupied cell, metres.

        At most `FAR_M`. Unknown cells count as free.
        """
        far = np.full(len(points), FAR_M)
        low, high = self.cells_of(np.stack([points.min(0) - FAR_M, points.max(0) + FAR_M]))
        low, high = np.clip([low, high + 1], 0, self.log_odds.shape)
        occupied = np.argwhere(self.log_odds[tuple(map(slice, low, high))] > 0)
        if not len(occupied):
            return far
        near, _ = cKDTree(self.centres_of(occupied + low)).query(points, distance_upper_bound=FAR_M)
        return np.asarray(np.minimum(near, far))

    def touch(self, point: Float64) -> None:
        """Mark the cell of a collision point (3,) as occupied until it is seen free."""
        cell = np.floor(point / self.cell_m).astype(np.int64)
        self._grow(cell, cell + 1)
        self.log_odds[tuple(cell - self.first)] = _CHANGE[STRUCK]

    def integrate(
        self, depth: NDArray[np.float32], T_world_camera: Float64, intrinsics: Intrinsics
    ) -> None:
        """Carve a depth image (H, W), metres, 0 = no reading, taken at a pose (4, 4)."""
        # The largest stride that skips no cell between two rays, up to the reach.
        stride = max(1, int(intrinsics.fx * self.cell_m / self.reach_m))
        every = slice(None, None, stride)
        rays = intrinsics.rays()[every, every]
        low, high = self._include(rays, T_world_camera)
        directions = rays.reshape(-1, 3) @ T_world_camera[:3, :3].T / self.cell_m
        start = T_world_camera[:3, 3] / self.cell_m - self.first - low
        with wp.ScopedDevice("cpu"):
            marks = wp.zeros(tuple(high - low), dtype=wp.int8)
            given = [
                wp.array(directions.astype(np.float32), dtype=wp.vec3),
                wp.array(np.ascontiguousarray(depth[every, every], np.float32).reshape(-1)),
                wp.vec3(*start),
                wp.vec3i(*marks.shape),
                self.cell_m,
                self.reach_m,
            ]
            # In this order, surface overrides free space, which overrides a missing reading.
            for mark in (BLANK, PASSED, STRUCK):
                wp.launch(mark_rays, len(directions), [*given, mark], [marks])
        self._apply(marks.numpy(), low, high)

    def _apply(self, marks: NDArray[np.int8], low: Int64, high: Int64) -> None:
        box = tuple(map(slice, low, high))
        change = _CHANGE[marks]
        old = self.log_odds[box]
        new = np.clip(old + change, -_LIMIT, _LIMIT)
        # No measurement makes a cell unknown again.
        self.log_odds[box] = np.where((new == 0) & (old != 0), np.sign(change), new)
        self.blanks[box] = np.minimum(self.blanks[box] + (marks == BLANK), 100)

    def _include(self, rays: Float64, T_world_camera: Float64) -> tuple[Int64, Int64]:
        """Grow to contain a whole view; return its lower and upper indices."""
        corners = self.reach_m * rays[[0, 0, -1, -1], [0, -1, 0, -1]]
        points = transform_points(T_world_camera, np.concatenate([np.zeros((1, 3)), corners]))
        cells = np.floor(points / self.cell_m).astype(np.int64)
        low, high = cells.min(axis=0) - 1, cells.max(axis=0) + 2
        self._grow(low, high)
        return low - self.first, high - self.first

    def _grow(self, low: Int64, high: Int64) -> None:
        shape = np.array(self.log_odds.shape)
        if not shape.any():
            self.first = low
        end = self.first + shape
        if (low >= self.first).all() and (high <= end).all():
            return
        first = np.where(low < self.first, low - _PAD, self.first)
        grown = np.where(high > end, high + _PAD, end) - first
        box = tuple(slice(a, a + n) for a, n in zip(self.first - first, shape, strict=True))
        log_odds, blanks = np.zeros(grown, np.int8), np.zeros(grown, np.int8)
        log_odds[box], blanks[box] = self.log_odds, self.blanks
        self.first, self.log_odds, self.blanks = first, log_odds, blanks


_MOST_SAMPLES = 5


def surrounding_occupancy(
    grid: OccupancyGrid, T_world_camera: Float64, blocks: tuple[int, int, int], block_m: float
) -> Float32:
    """Shares of free and of occupied space in blocks around a camera, (2, X, Y, Z) in [0, 1].

    The rest of a block is unknown. Blocks are aligned with the camera's axes (x right, y down, z
    forward) and centred on it. Each is sampled densely enough to skip no cell, with at most five
    points along an edge.

    Args:
        grid: the known occupancy.
        T_world_camera: (4, 4).
        blocks: X, Y, Z, number of blocks along each axis.
        block_m: edge of a block, metres.
    """
    samples = min(_MOST_SAMPLES, math.ceil(block_m / grid.cell_m - 1e-9))
    corner = -0.5 * block_m * np.array(blocks)
    start = T_world_camera[:3, :3] @ corner + T_world_camera[:3, 3]
    with wp.ScopedDevice("cpu"):
        shares = wp.zeros((2, *blocks), dtype=float)
        given = [
            wp.array(grid.log_odds, dtype=wp.int8, copy=False),
            wp.mat33(*(T_world_camera[:3, :3] * block_m / grid.cell_m).ravel()),
            wp.vec3(*(start / grid.cell_m - grid.first)),
            samples,
        ]
        wp.launch(count_states, blocks, given, [shares])
    return np.asarray(shares.numpy())


class _Carved(NamedTuple):
    """A frame and the pose at which it was carved."""

    number: int  # in SLAM's count
    depth: NDArray[np.float32]
    T_world_camera: Float64


class HasCorrections(Protocol):
    """Provides the corrected poses of SLAM's frames: SLAM, or a robot's view of it."""

    @property
    def frames_counted(self) -> int:
        """See ``SlamBackend``."""

    def corrected_trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """See ``SlamBackend``."""

    def submaps(self) -> Submaps:
        """See ``SlamBackend``."""


class OccupancyMap:
    """An occupancy grid that keeps its frames and carves them again when SLAM moves them.

    ``grid`` holds the frames of the present submap and those joined to it. Other submaps are left
    out: their pose is uncertain, and their frames would be carved in the wrong place.

    Args:
        cell_m: edge of a cell, metres.
        reach_m: depth up to which a ray marks free and occupied cells, metres.
    """

    def __init__(self, cell_m: float = 0.1, reach_m: float = 3.5) -> None:
        self.cell_m, self.reach_m = cell_m, reach_m
        self.grid = OccupancyGrid(cell_m, reach_m)
        self._frames: list[_Carved] = []
        self._in_grid: set[int] = set()

    def add(
        self,
        slam: HasCorrections,
        depth: NDArray[np.float32],
        T_world_camera: Float64,
        intrinsics: Intrinsics,
    ) -> None:
        """Add the frame (H, W), metres, that ``slam`` tracked last, at its pose (4, 4)."""
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

    def _follow(self, slam: HasCorrections) -> bool:
        """Update the frames to SLAM's present poses; return whether one in the grid has moved."""
        numbers, poses = slam.corrected_trajectory()
        now = dict(zip(numbers.tolist(), poses, strict=True))
        moved = False
        for index, frame in enumerate(self._frames):
            pose = now.get(frame.number)
            if pose is None:
                continue
            # Each entry of the rotation gives how far points along an axis have turned.
            apart = np.abs(pose - frame.T_world_camera)[:3] @ [*[self.reach_m] * 3, 1.0]
            if apart.max() > 0.5 * self.cell_m:
                self._frames[index] = frame._replace(T_world_camera=pose)
                moved |= frame.number in self._in_grid
        return moved


def _of_present_submap(submaps: Submaps, numbers: list[int]) -> set[int]:
    """The frames in the submap of the last one, or in a submap joined to it."""
    roots = submaps.joined_to[np.searchsorted(submaps.first_frames, numbers, side="right") - 1]
    return {number for number, root in zip(numbers, roots, strict=True) if root == roots[-1]}
