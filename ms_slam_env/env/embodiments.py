"""The embodiments by name, built from the environment's configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ms_slam_env.env.config import EnvConfig
from ms_slam_env.robot import (
    NUM_MOTIONS,
    NUM_ROTATIONS,
    Embodiment,
    FixedTranslation,
    FreeCamera,
)
from ms_slam_env.robot.arm.dynamic_arm import DynamicArm
from ms_slam_env.robot.arm.kinematic_arm import KinematicArm
from ms_slam_env.scenes.base import Scene
from ms_slam_env.timings import Timings


@dataclass(frozen=True)
class EmbodimentType:
    """How many actions an embodiment has, and how to build it in a scene."""

    num_actions: int
    build: Callable[[Scene, EnvConfig, Timings], Embodiment]


def _free(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return FreeCamera(scene, config.step_m, config.step_rad)


def _fixed_translation(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return FixedTranslation(scene, config.step_m, config.step_rad)


def _arm(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return DynamicArm(scene, config.arm, config.step_m, config.step_rad, timings)


def _arm_kinematic(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
    return KinematicArm(scene, config.arm, config.step_m, config.step_rad, timings)


EMBODIMENTS = {
    "arm": EmbodimentType(NUM_MOTIONS, _arm),
    "arm-kinematic": EmbodimentType(NUM_MOTIONS, _arm_kinematic),
    "free": EmbodimentType(NUM_MOTIONS, _free),
    "fixed-translation": EmbodimentType(NUM_ROTATIONS, _fixed_translation),
}
"""Name of the option ``embodiment`` to type."""
