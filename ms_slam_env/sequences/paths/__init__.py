"""Ways of a camera through a scene, seeded or placed there.

Seeded ones are frozen dataclasses, a `CameraPath` each, which names of sequences can say.
"""

from ms_slam_env.sequences.paths.base import CameraPath
from ms_slam_env.sequences.paths.handheld import HandheldPath
from ms_slam_env.sequences.paths.paced import MotionSegments, UnevenPath
from ms_slam_env.sequences.paths.placement import Placement, place_trajectory
from ms_slam_env.sequences.paths.route import RoutePath
from ms_slam_env.sequences.paths.wandering import (
    WanderingPath,
    handheld_trajectory,
    repeated_trajectory,
)

__all__ = [
    "CameraPath",
    "HandheldPath",
    "MotionSegments",
    "Placement",
    "RoutePath",
    "UnevenPath",
    "WanderingPath",
    "handheld_trajectory",
    "place_trajectory",
    "repeated_trajectory",
]
