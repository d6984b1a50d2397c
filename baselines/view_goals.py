"""Candidate goal poses: random views, poses on a line, and frontiers."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import look_at, make_pose, so3_exp, so3_log
from ms_slam_env.planning import OccupancyGrid
from ms_slam_env.planning.view_goals import upright_poses

_PITCH_RAD = 0.7


def views_anywhere(rng: np.random.Generator, positions: Float64) -> Float64:
    """Upright poses (N, 4, 4) at positions (N, 3) in random directions, not straight up or down."""
    yaw = rng.uniform(-np.pi, np.pi, len(positions))
    pitch = rng.uniform(-_PITCH_RAD, _PITCH_RAD, len(positions))
    return upright_poses(positions, yaw, pitch)


def poses_between(start: Float64, end: Float64, number: int) -> Float64:
    """Poses (number, 4, 4) on the straight path from ``start`` to ``end`` (4, 4), ``end`` last."""
    turn = so3_log(start[:3, :3].T @ end[:3, :3])
    shares = np.arange(1, number + 1) / number
    places = start[:3, 3] + shares[:, None] * (end[:3, 3] - start[:3, 3])
    turns = [start[:3, :3] @ so3_exp(share * turn) for share in shares]
    return np.stack([make_pose(R, place) for R, place in zip(turns, places, strict=True)])


def frontiers(grid: OccupancyGrid, position: Float64, radius_m: float, least: int = 10) -> Float64:
    """Centres (K, 3), metres, of the frontiers near a position (3,), the largest first.

    Frontier cells are free and have an unknown neighbour (Yamauchi, CIRA 1997). A frontier is a
    connected set of at least ``least`` of them.
    """
    here, reach = grid.cells_of(position), int(radius_m / grid.cell_m)
    low = np.clip(here - reach, 0, grid.log_odds.shape)
    high = np.clip(here + reach + 1, low, grid.log_odds.shape)
    states = grid.log_odds[tuple(map(slice, low, high))]
    is_frontier = (states < 0) & ndimage.binary_dilation(states == 0)
    parts, count = ndimage.label(is_frontier, np.ones((3, 3, 3)))
    cells = np.argwhere(is_frontier)
    part = parts[tuple(cells.T)]
    ends = np.cumsum(np.bincount(part, minlength=count + 1)[1:])
    members = np.split(cells[np.argsort(part, kind="stable")], ends[:-1])
    members = sorted((m for m in members if len(m) >= least), key=len, reverse=True)
    middles = [m[np.argmin(((m - m.mean(axis=0)) ** 2).sum(axis=1))] for m in members]
    return grid.centres_of(np.array(middles).reshape(-1, 3) + low)


def views_of(targets: Float64, free: Float64, here: Float64, away_m: float) -> Float64:
    """Poses (K, 4, 4) that look at targets (K, 3) from positions in ``free`` (M, 3).

    Positions about ``away_m`` from the target and near ``here`` (3,) are preferred; views straight
    up or down are excluded.
    """
    poses = []
    for target in targets:
        distance = np.linalg.norm(free - target, axis=1)
        level = np.linalg.norm((free - target)[:, :2], axis=1) > 0.5 * distance
        way = np.abs(distance - away_m) + 0.5 * np.linalg.norm(free - here, axis=1)
        if level.any():
            poses.append(look_at(free[np.argmin(np.where(level, way, np.inf))], target))
    return np.array(poses).reshape(-1, 4, 4)
