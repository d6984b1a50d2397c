"""Motions of the camera, and the embodiments that carry it."""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.robot.action_primitives import (
        NUM_MOTIONS,
        NUM_ROTATIONS,
        NUM_TRANSLATIONS,
        ROTATIONS,
        TRANSLATIONS,
        decompose,
        describe,
    )
    from ms_slam_env.robot.embodiment import Embodiment, MotionResult
    from ms_slam_env.robot.free_camera import CAMERA_RADIUS_M, FixedTranslation, FreeCamera
else:
    __getattr__ = lazy_names(__name__)

__all__ = [
    "CAMERA_RADIUS_M",
    "NUM_MOTIONS",
    "NUM_ROTATIONS",
    "NUM_TRANSLATIONS",
    "ROTATIONS",
    "TRANSLATIONS",
    "Embodiment",
    "FixedTranslation",
    "FreeCamera",
    "MotionResult",
    "decompose",
    "describe",
]
