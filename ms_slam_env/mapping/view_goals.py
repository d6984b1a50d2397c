"""Poses of free space worth going to, and how many motions away they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.mapping.expected_gain import expected_gain
from ms_slam_env.mapping.occupancy_grid import OccupancyGrid
from ms_slam_env.mapping.reachability import reachable_positions

Float64 = NDArray[np.float64]

_COST = 0.7  # a view six steps farther away is worth exp(-0.7) times as much
_RADIUS_M = 2.5  # how far a goal may be
_GOALS, _TURNS = 48, 16  # compared: elsewhere, and where the camera is
_GOAL_RAYS = (8, 6)
_PITCH_RAD = 0.7
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def distance_in_steps(poses: Float64, goal: Float64, step_m: float, step_rad: float) -> Float64:
    """Translations and rotations (N, 2) of one motion each, from ``poses`` (N, 4, 4) to a goal."""
    metres = np.linalg.norm(poses[:, :3, 3] - goal[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], goal[:3, :3]) - 1) / 2
    return np.stack([metres / step_m, np.arccos(np.clip(cosine, -1, 1)) / step_rad], axis=1)


def upright_poses(positions: Float64, yaw: Float64, pitch: Float64) -> Float64:
    """Poses (N, 4, 4) at positions (N, 3) that look along yaw and pitch (N,), radians."""
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
    grid: OccupancyGrid, here: Float64, intrinsics: Intrinsics, steps: tuple[float, float]
) -> Float64:
    """The pose (4, 4) most worth its way, of some in free space and some where the camera is.

    Gain is weighed by exp(-lambda cost) (Bircher et al., ICRA 2016), cost the distance in
    ``steps``, metres and radians of one motion. A function of what is known alone: which cells are
    compared, and where the camera looks from them, are drawn by a hash of the cell, so that a goal
    stays while nothing better is found.
    """
    free = reachable_positions(grid, here[:3, 3], _RADIUS_M)
    drawn = _hash(np.floor(free / grid.cell_m).astype(np.int64))
    chosen = np.argsort(drawn, kind="stable")[:_GOALS]
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
    """Well mixed numbers (N,) of cells (N, 3)."""
    mixed = (cells.astype(np.uint64) * _MIX).sum(axis=1, dtype=np.uint64)
    for shift in (30, 27, 31):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * _MIX[0]
    return mixed ^ (mixed >> np.uint64(32))
