"""Embodiments by name, built from the environment's configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ms_slam_env._runtime.extension import load_reference
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.env.env_config import EnvConfig
from ms_slam_env.env.pose_sources import KINEMATIC_SOURCES
from ms_slam_env.errors import InputError
from ms_slam_env.robot import NUM_MOTIONS, Embodiment, FixedTranslation, FreeCamera
from ms_slam_env.robot.arm import ArmConfig, load_arm
from ms_slam_env.scenes.scene import Scene


@dataclass(frozen=True)
class EmbodimentType:
    """The number of motions of an embodiment, and how to build it in a scene.

    ``check`` raises an InputError if the configuration cannot be built in any scene.
    """

    num_motions: int
    build: Callable[[Scene, EnvConfig, Timings], Embodiment]
    check: Callable[[EnvConfig], None]


def _arm(reference: str) -> EmbodimentType:
    """An arm; its planning and physics are imported only when one is built."""

    def build(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
        cls = load_reference(reference)
        arm: Embodiment = cls(scene, config.arm, config.step_m, config.step_rad, timings)
        return arm

    def check(config: EnvConfig) -> None:  # a bad file is refused before the first reset
        if config.frames_per_action != 1:
            raise InputError(
                "frames_per_action is for cameras that nothing holds; for the arm give "
                "arm.frames_per_action"
            )
        load_arm(config.arm.model, config.arm.camera_site, config.arm.joint_speed_rad_s)

    return EmbodimentType(NUM_MOTIONS, build, check)


def _free(cls: type[FreeCamera] | type[FixedTranslation]) -> EmbodimentType:
    def build(scene: Scene, config: EnvConfig, timings: Timings) -> Embodiment:
        return cls(scene, config.step_m, config.step_rad, config.frames_per_action)

    return EmbodimentType(cls.num_actions, build, _has_no_arm)


def _has_no_arm(config: EnvConfig) -> None:
    """Refuse options that need an arm."""
    hint = "needs an arm: embodiment='arm' or 'arm-kinematic', as MSActiveSLAM-v0 has"
    if config.pose in KINEMATIC_SOURCES:
        raise InputError(f"pose={config.pose!r} {hint}; nothing holds a free camera")
    if config.arm != ArmConfig():
        raise InputError(f"option 'arm' {hint}; nothing holds a free camera")


EMBODIMENTS = {
    "arm": _arm("ms_slam_env.robot.arm.dynamic_arm:DynamicArm"),
    "arm-kinematic": _arm("ms_slam_env.robot.arm.arm:KinematicArm"),
    "free": _free(FreeCamera),
    "fixed-translation": _free(FixedTranslation),
}
"""Embodiment type of each name of the option ``embodiment``."""
