"""Scenes and their sensors, built once a process and shared by its environments."""

from __future__ import annotations

from functools import lru_cache

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics
from ms_slam_env.scenes.base import Scene
from ms_slam_env.scenes.registry import SceneName
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.noise import NoiseConfig

_SCENES_KEPT = 32  # a scene with its textures takes tens of megabytes


@lru_cache(maxsize=_SCENES_KEPT)
def get_scene(name: SceneName, seed: int) -> Scene:
    """The scene ``name`` with ``seed``; built at the first call."""
    return scenes.make(name, seed=seed)


@lru_cache(maxsize=_SCENES_KEPT)
def get_sensor(
    name: SceneName, seed: int, intrinsics: Intrinsics, noise: str | NoiseConfig
) -> RGBDSensor:
    """A sensor looking at that scene; its noise seed is set by each environment."""
    return RGBDSensor(get_scene(name, seed), intrinsics, noise=noise)
