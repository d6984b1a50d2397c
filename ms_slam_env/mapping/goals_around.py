"""Views around a camera in a fixed order: what an agent can be shown of where to go."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ms_slam_env.camera import Intrinsics
from ms_slam_env.mapping.expected_gain import expected_gain
from ms_slam_env.mapping.occupancy_grid import OccupancyGrid
from ms_slam_env.mapping.view_goals import upright_poses

Float64 = NDArray[np.float64]

_HEADINGS = 8
_RINGS_M = (0.5, 1.0, 2.0)
_HEIGHTS_M = (-0.5, 0.5)  # above where the camera is
_PITCHES_RAD = (-0.5, 0.5)  # looked along as well where the camera is
_RAYS = (6, 4)
_REACH_M = 2.5  # how far free space is followed along each axis

NUM_POSITIONS = 1 + len(_RINGS_M) * _HEADINGS + len(_HEIGHTS_M)
NUM_GOALS = (NUM_POSITIONS + len(_PITCHES_RAD)) * _HEADINGS


def goals_around(here: Float64) -> Float64:
    """Upright poses (NUM_GOALS, 4, 4) around a camera's (4, 4), ordered from its heading on.

    Eight level views, 45 degrees apart, from each of NUM_POSITIONS positions: here, on three rings
    (the headings of a ring one after another), below and above; then eight views from here that
    look down and eight that look up. A camera that looks straight up or down heads along x.
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


def gain_around(grid: OccupancyGrid, here: Float64, intrinsics: Intrinsics) -> Float64:
    """Expected gain (NUM_GOALS,) in m^3 of `goals_around`; 0 where free space does not lead.

    Free space leads to a position if its cell is free and joined to the free cell nearest to
    ``here``, by faces of free cells within 2.5 m of it along each axis. Where the camera is that is
    not asked: its own cell may be unknown yet.
    """
    goals = goals_around(here)
    gain = expected_gain(grid, goals, intrinsics, _RAYS)
    stays = (goals[:, :3, 3] == here[:3, 3]).all(axis=1)
    positions = goals[::_HEADINGS, :3, 3]
    led_to = np.repeat(_is_led_to(grid, here[:3, 3], positions), _HEADINGS)
    return np.asarray(gain * (stays | led_to))


def _is_led_to(grid: OccupancyGrid, start: Float64, positions: Float64) -> NDArray[np.bool_]:
    """Which of positions (N, 3) free space leads to from ``start`` (3,)."""
    cell, reach = grid.cells_of(start), int(_REACH_M / grid.cell_m)
    low = np.clip(cell - reach, 0, grid.log_odds.shape)
    high = np.clip(cell + reach + 1, low, grid.log_odds.shape)
    free = grid.log_odds[tuple(map(slice, low, high))] < 0
    regions, _ = ndimage.label(free)
    own = cell - low
    inside = (own >= 0).all() and (own < regions.shape).all()
    if not (inside and free[tuple(own)]):
        cells = np.argwhere(free)
        if not len(cells):
            return np.zeros(len(positions), dtype=bool)
        own = cells[np.argmin(((cells - own) ** 2).sum(axis=1))]
    cells = grid.cells_of(positions) - low
    known = ((cells >= 0) & (cells < regions.shape)).all(axis=1)
    cells[~known] = 0
    return np.asarray(known & (regions[tuple(cells.T)] == regions[tuple(own)]))
