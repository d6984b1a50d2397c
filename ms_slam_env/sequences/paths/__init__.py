"""Camera paths through a scene: seeded ones, and recorded motions placed in the scene.

Seeded ones are frozen dataclasses derived from `CameraPath`, and can be part of sequence names.
"""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.sequences.paths.camera_path import CameraPath
    from ms_slam_env.sequences.paths.handheld import HandheldPath
    from ms_slam_env.sequences.paths.paced import MotionSegments, UnevenPath
    from ms_slam_env.sequences.paths.placement import Placement, place_trajectory
    from ms_slam_env.sequences.paths.route import RoutePath
    from ms_slam_env.sequences.paths.wandering import (
        WanderingPath,
        handheld_trajectory,
    )
else:
    __getattr__ = lazy_names(__name__)

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
]
