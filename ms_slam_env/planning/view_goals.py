"""Reachable positions in free space, shortest paths to them, and the best goal pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.planning.expected_gain import expected_gain
from ms_slam_env.planning.occupancy_grid import OccupancyGrid

_NEIGHBOURS = ndimage.generate_binary_structure(3, 1)


def reachable_positions(grid: OccupancyGrid, position: Float64, radius_m: float) -> Float64:
    """Centres (N, 3), metres, of the cells that a camera at ``position`` (3,) can reach.

    These are free cells within a cube of half edge ``radius_m`` whose six neighbours are free too,
    connected to the one nearest to ``position``. Empty if there is none.
    """
    return grid.centres_of(_reachable_cells(grid, grid.cells_of(position), radius_m))


def _reachable_cells(grid: OccupancyGrid, here: Int64, radius_m: float) -> Int64:
    """Indices (N, 3) of the cells of `reachable_positions`, from one (3,)."""
    reach = int(radius_m / grid.cell_m)
    low = np.maximum(here - reach, 0)
    high = np.maximum(np.minimum(here + reach + 1, grid.log_odds.shape), low)
    free = grid.log_odds[tuple(map(slice, low, high))] < 0
    if not free.any():
        return np.zeros((0, 3), np.int64)
    box = _box_of(free)  # a small part of the grid, which includes all that a view might reach
    low = low + [along.start for along in box]
    regions, _ = ndimage.label(_inner(free[box]), _NEIGHBOURS)
    inside = np.argwhere(regions > 0)
    if not len(inside):
        return inside
    nearest = inside[np.argmin(((inside + low - here) ** 2).sum(axis=1))]
    return np.argwhere(regions == regions[tuple(nearest)]) + low


def _box_of(mask: NDArray[np.bool_]) -> tuple[slice, ...]:
    """The smallest box around the true cells of a mask (X, Y, Z)."""
    along = [np.any(mask, axis=others) for others in ((1, 2), (0, 2), (0, 1))]
    ends = [np.flatnonzero(some)[[0, -1]] for some in along]
    return tuple(slice(int(first), int(last) + 1) for first, last in ends)


def _inner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (X, Y, Z) that are true with all six neighbours; beyond the border all are false."""
    inner = mask.copy()
    for axis in range(3):
        along, of = np.moveaxis(inner, axis, 0), np.moveaxis(mask, axis, 0)
        along[1:] &= of[:-1]
        along[:-1] &= of[1:]
        along[[0, -1]] = False
    return inner


@dataclass(frozen=True)
class Ways:
    """Shortest paths from one position to all N, itself included.

    Attributes:
        positions: (N, 3) metres; the first is the start.
        lengths: (N,) length of the path to each, metres.
        before: (N,) index of the position before each on its path; negative for the first.
    """

    positions: Float64
    lengths: Float64
    before: NDArray[np.int32]

    def to(self, end: int) -> Float64:
        """Positions (K, 3) of the path to position ``end``, from the start."""
        indices = [end]
        while self.before[indices[-1]] >= 0:
            indices.append(int(self.before[indices[-1]]))
        return self.positions[indices[::-1]]


def shortest_ways(grid: OccupancyGrid, position: Float64, radius_m: float) -> Ways:
    """Shortest paths (Dijkstra) from ``position`` (3,) through the cells of `reachable_positions`.

    Every other cell along each axis is a node, linked to its up to 26 neighbouring nodes: between
    two cells with free neighbours there are only free cells. Unreachable nodes are left out.
    """
    here = grid.cells_of(position)
    cells = _reachable_cells(grid, here, radius_m)
    nodes = cells[((cells - here) % 2 == 0).all(axis=1)] // 2
    if not len(nodes):
        return Ways(position[None].copy(), np.zeros(1), np.full(1, -1, np.int32))
    low = nodes.min(axis=0) - 1
    shape = nodes.max(axis=0) - low + 2
    index = np.full(math.prod(shape), -1)
    flat = np.ravel_multi_index(tuple((nodes - low).T), tuple(shape))
    index[flat] = np.arange(len(nodes))
    others = index[flat[:, None] + _HALF_OF_26 @ [shape[1] * shape[2], shape[2], 1]]
    joined = others >= 0
    metres = np.broadcast_to(2 * grid.cell_m * np.linalg.norm(_HALF_OF_26, axis=1), joined.shape)
    edges = metres[joined], others[joined], np.append(0, np.cumsum(joined.sum(axis=1)))
    lengths = sparse.csr_array(edges, shape=(len(nodes), len(nodes)))
    centres = grid.centres_of(2 * nodes + here % 2)
    first = int(np.argmin(((centres - position) ** 2).sum(axis=1)))
    found, before = dijkstra(lengths, directed=False, indices=first, return_predecessors=True)
    order = np.argsort(found, kind="stable")[: np.isfinite(found).sum()]
    place = np.full(len(nodes), -1, np.int32)
    place[order] = np.arange(len(order))
    earlier = np.where(before[order] < 0, -1, place[np.maximum(before[order], 0)])
    return Ways(centres[order], found[order], earlier.astype(np.int32))


_HALF_OF_26 = np.argwhere(np.ones((3, 3, 3)))[14:] - 1


_COST = 0.7  # a view six steps farther away is worth exp(-0.7) times as much
GOAL_RADIUS_M = 2.5  # largest distance of a goal
_GOALS, _TURNS = 48, 16  # goals compared elsewhere, and at the camera's position
_GOAL_RAYS = (8, 6)
_PITCH_RAD = 0.7
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def distance_in_steps(poses: Float64, goal: Float64, step_m: float, step_rad: float) -> Float64:
    """Distance (N, 2) from ``poses`` (N, 4, 4) to a goal, in steps of translation and rotation."""
    metres = np.linalg.norm(poses[:, :3, 3] - goal[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], goal[:3, :3]) - 1) / 2
    return np.stack([metres / step_m, np.arccos(np.clip(cosine, -1, 1)) / step_rad], axis=1)


def upright_poses(positions: Float64, yaw: Float64, pitch: Float64) -> Float64:
    """Upright poses (N, 4, 4) at positions (N, 3) that look along yaw and pitch (N,), radians."""
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1
    )
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=1)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = positions
    return poses


def best_goal(
    grid: OccupancyGrid,
    here: Float64,
    intrinsics: Intrinsics,
    steps: tuple[float, float],
    free: Float64 | None = None,
) -> Float64:
    """The best goal pose (4, 4) among some in free space and some at the camera's position.

    Gain is weighted by exp(-lambda cost) (Bircher et al., ICRA 2016); the cost is the distance in
    ``steps``. The result depends on the arguments alone: the cells compared, and the views from
    them, are drawn by a hash of the cell, so that a goal stays until a better one is found.

    Args:
        grid: the known occupancy.
        here: (4, 4) current pose.
        intrinsics: of the camera.
        steps: translation, metres, and rotation, radians, of one motion.
        free: `reachable_positions` (N, 3) within GOAL_RADIUS_M, if already computed.
    """
    if free is None:
        free = reachable_positions(grid, here[:3, 3], GOAL_RADIUS_M)
    drawn = _hash(np.floor(free / grid.cell_m).astype(np.int64))
    chosen = np.arange(len(drawn))
    if len(drawn) > _GOALS:  # a full sort took a millisecond
        chosen = np.argpartition(drawn, _GOALS)[:_GOALS]
    chosen = chosen[np.argsort(drawn[chosen], kind="stable")]
    yaw, pitch = ((drawn[chosen] >> np.uint64(k) & np.uint64(0xFFFF)) / 65536 for k in (0, 16))
    positions = np.concatenate([np.repeat(here[None, :3, 3], _TURNS, axis=0), free[chosen]])
    poses = upright_poses(
        positions,
        2 * np.pi * np.concatenate([np.arange(_TURNS) / _TURNS, yaw]),
        _PITCH_RAD * np.concatenate([np.zeros(_TURNS), 2 * pitch - 1]),
    )
    gain = expected_gain(grid, poses, intrinsics, _GOAL_RAYS)
    away = 1 + distance_in_steps(poses, here, *steps).max(axis=1)
    return poses[int(np.argmax(gain * np.exp(-_COST * away / 6)))]


def _hash(cells: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Well-mixed hashes (N,) of cells (N, 3)."""
    mixed = (cells.astype(np.uint64) * _MIX).sum(axis=1, dtype=np.uint64)
    for shift in (30, 27, 31):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * _MIX[0]
    return mixed ^ (mixed >> np.uint64(32))
