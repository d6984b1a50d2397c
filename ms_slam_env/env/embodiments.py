"""The embodiments by name, built from the environment's configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ms_slam_env.env.config import EnvConfig
from ms_slam_env.env.pose_sources import KINEMATIC_SOURCES
from ms_slam_env.errors import InputError
from ms_slam_env.robot import (
    NUM_MOTIONS,
    NUM_ROTATIONS,
    Embodiment,
    FixedTranslation,
    FreeCamera,
)
from ms_slam_env.robot.arm import ArmConfig, load_arm
from ms_slam_env.robot.arm.arm import KinematicArm
from ms_slam_env.robot.arm.dynamic_arm import DynamicArm
from ms_slam_env.scenes.base import Scene
from ms_slam_env.timings import Timings


@dataclass(frozen=True)
class EmbodimentType:
    """How many actions an embodiment has, and how to build it in a scene.

    ``check`` raises an InputError if the configuration cannot be built anywhere.
    """

    num_actions: int
    build: Callable[[Scene, EnvConfig, Timings], Embodiment]
    check: Callable[[EnvConfig], None]


def _free(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return FreeCamera(scene, config.step_m, config.step_rad)


def _fixed_translation(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return FixedTranslation(scene, config.step_m, config.step_rad)


def _arm(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return DynamicArm(scene, config.arm, config.step_m, config.step_rad, timings)


def _arm_kinematic(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return KinematicArm(scene, config.arm, config.step_m, config.step_rad, timings)


def _has_no_arm(config: EnvConfig) -> None:
    """Refuse what only an arm has."""
    hint = "needs an arm: embodiment='arm' or 'arm-kinematic', as MSActiveSLAM-v0 has"
    if config.pose in KINEMATIC_SOURCES:
        raise InputError(f"pose={config.pose!r} {hint}; nothing holds a free camera")
    if config.arm != ArmConfig():
        raise InputError(f"option 'arm' {hint}; nothing holds a free camera")


def _needs_an_arm(config: EnvConfig) -> None:
    """Read the arm's file, so that a bad one is refused before the first reset."""
    load_arm(config.arm.model, config.arm.camera_site, config.arm.joint_speed_rad_s)


EMBODIMENTS = {
    "arm": EmbodimentType(NUM_MOTIONS, _arm, _needs_an_arm),
    "arm-kinematic": EmbodimentType(NUM_MOTIONS, _arm_kinematic, _needs_an_arm),
    "free": EmbodimentType(NUM_MOTIONS, _free, _has_no_arm),
    "fixed-translation": EmbodimentType(NUM_ROTATIONS, _fixed_translation, _has_no_arm),
}
"""Name of the option ``embodiment`` to type."""
