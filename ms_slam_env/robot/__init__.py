"""Motions and embodiments of the camera."""

from ms_slam_env.robot.base import Embodiment, Movement
from ms_slam_env.robot.free_camera import CAMERA_RADIUS_M, FixedTranslation, FreeCamera
from ms_slam_env.robot.motions import (
    NUM_MOTIONS,
    NUM_ROTATIONS,
    NUM_TRANSLATIONS,
    ROTATIONS,
    TRANSLATIONS,
    decompose,
    describe,
)

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
    "Movement",
    "decompose",
    "describe",
]
