"""Scenes and their sensors, built once a process and shared by its environments."""

from __future__ import annotations

from collections import OrderedDict
from threading import RLock
from typing import Any

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics
from ms_slam_env.scenes.registry import SceneName
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.noise import NoiseConfig

FACES_KEPT = 1_000_000
"""Faces of all scenes that are kept, the last one used in any case.

With textures, trees and surfaces a room of 50,000 faces takes 35 to 75 MB, a home of 180,000 some
250 MB: at most 1.5 GB for 20 rooms or five homes, in each of the processes of a training.
"""

SENSORS_KEPT = 2
"""Of a scene, those used last: a curriculum draws noise for each episode."""

_kept: OrderedDict[tuple[SceneName, int], tuple[Scene, dict[Any, RGBDSensor]]] = OrderedDict()
_lock = RLock()


def get_scene(name: SceneName, seed: int) -> Scene:
    """The scene ``name`` with ``seed``; built at the first call, and where it is no longer kept."""
    return _place(name, seed)[0]


def get_sensor(
    name: SceneName, seed: int, intrinsics: Intrinsics, noise: str | NoiseConfig
) -> RGBDSensor:
    """A sensor looking at that scene; its noise seed is set by each environment."""
    with _lock:
        scene, sensors = _place(name, seed)
        key = intrinsics, noise
        sensor = sensors.pop(key, None)
        if sensor is None:
            alike = next(
                (one for (camera, _), one in sensors.items() if camera == intrinsics), None
            )
            sensor = alike.with_noise(noise) if alike else RGBDSensor(scene, intrinsics, noise)
        while len(sensors) >= SENSORS_KEPT:
            del sensors[next(iter(sensors))]
        sensors[key] = sensor
        return sensor


def _place(name: SceneName, seed: int) -> tuple[Scene, dict[Any, RGBDSensor]]:
    """A scene and its sensors; those longest not asked for go where there are too many faces."""
    key = name, seed
    with _lock:
        if key not in _kept:
            _kept[key] = scenes.make(name, seed=seed), {}
        _kept.move_to_end(key)
        while len(_kept) > 1 and _faces_kept() > FACES_KEPT:
            _kept.popitem(last=False)
        return _kept[key]


def _faces_kept() -> int:
    return sum(len(scene.mesh.faces) for scene, _ in _kept.values())
