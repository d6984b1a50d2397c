"""Occupancy of space, the information gain of views, and where a camera can go."""

from ms_slam_env.planning.expected_gain import expected_gain, held_gain
from ms_slam_env.planning.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyMap,
    surrounding_occupancy,
)
from ms_slam_env.planning.trackability import view_information
from ms_slam_env.planning.view_goals import Ways, reachable_positions, shortest_ways

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "OccupancyGrid",
    "OccupancyMap",
    "Ways",
    "expected_gain",
    "held_gain",
    "reachable_positions",
    "shortest_ways",
    "surrounding_occupancy",
    "view_information",
]
