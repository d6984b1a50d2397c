"""Candidate goal views around a camera in a fixed order, for an agent's observation."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.planning.expected_gain import expected_gain
from ms_slam_env.planning.occupancy_grid import OccupancyGrid
from ms_slam_env.planning.view_goals import upright_poses

_HEADINGS = 8
_RINGS_M = (0.5, 1.0, 2.0)
_HEIGHTS_M = (-0.5, 0.5)  # above the camera
_PITCHES_RAD = (-0.5, 0.5)  # of additional views from the camera's position
_RAYS = (6, 4)

NUM_POSITIONS = 1 + len(_RINGS_M) * _HEADINGS + len(_HEIGHTS_M)
NUM_GOALS = (NUM_POSITIONS + len(_PITCHES_RAD)) * _HEADINGS


def goals_around(here: Float64) -> Float64:
    """Upright poses (NUM_GOALS, 4, 4) around a camera pose (4, 4), ordered from its heading on.

    Eight level views, 45 degrees apart, from each of NUM_POSITIONS positions: the camera's own,
    then three rings (one heading after another), below and above; then eight views from the
    camera's position that look down and eight that look up. The heading of a camera that looks
    straight up or down is x.
    """
    heading = np.arctan2(here[1, 2], here[0, 2])
    around = heading + 2 * np.pi / _HEADINGS * np.arange(_HEADINGS)
    level = np.stack([np.cos(around), np.sin(around), np.zeros(_HEADINGS)], axis=1)
    rings = [radius * level for radius in _RINGS_M]
    heights = np.array([[0, 0, height] for height in _HEIGHTS_M])
    offsets = np.concatenate([np.zeros((1, 3)), *rings, heights])
    offsets = np.concatenate([offsets, np.zeros((len(_PITCHES_RAD), 3))])
    positions = here[:3, 3] + np.repeat(offsets, _HEADINGS, axis=0)
    pitch = np.repeat([*(0.0,) * NUM_POSITIONS, *_PITCHES_RAD], _HEADINGS)
    return upright_poses(positions, np.tile(around, len(offsets)), pitch)


def gain_around(
    grid: OccupancyGrid, here: Float64, intrinsics: Intrinsics, free: Float64
) -> Float64:
    """Expected gain (NUM_GOALS,) in m^3 of `goals_around`; 0 for positions out of reach.

    Args:
        grid: the known occupancy.
        here: (4, 4) current pose; its position counts as reachable in every direction.
        intrinsics: of the camera.
        free: centres (N, 3) of the cells that it can reach, from `reachable_positions`.
    """
    goals = goals_around(here)
    is_free = np.zeros_like(grid.log_odds, dtype=np.bool_)
    is_free[tuple(grid.cells_of(free).T)] = True
    cells = grid.cells_of(goals[::_HEADINGS, :3, 3])
    led_to = np.asarray(((cells >= 0) & (cells < is_free.shape)).all(axis=1))
    led_to[led_to] = is_free[tuple(cells[led_to].T)]
    stays = (goals[:, :3, 3] == here[:3, 3]).all(axis=1)
    can = stays | np.repeat(led_to, _HEADINGS)
    gain = np.zeros(len(goals))
    gain[can] = expected_gain(grid, goals[can], intrinsics, _RAYS)
    return gain
