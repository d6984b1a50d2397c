"""SLAM backends by name, and their common interface."""

from ms_slam_env.slam.configuration import (
    SlamConfiguration,
    is_file_name,
    make,
    open_map,
    read_configuration,
    write_configuration,
)
from ms_slam_env.slam.registry import BACKENDS, PEERS, POINT, check_parameters
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import BorrowedMap, SlamBackend, TrackResult, Views

__all__ = [
    "BACKENDS",
    "PEERS",
    "POINT",
    "BorrowedMap",
    "Saved",
    "SlamBackend",
    "SlamConfiguration",
    "TrackResult",
    "Views",
    "check_parameters",
    "is_file_name",
    "make",
    "open_map",
    "read_configuration",
    "write_configuration",
]
