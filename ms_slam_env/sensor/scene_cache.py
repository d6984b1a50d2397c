"""Cache of scenes and sensors, built once per process and shared by its environments."""

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
"""Most faces of all cached scenes; the last one used is always kept.

With textures, trees and surfaces a room of 50,000 faces takes 35 to 75 MB, and a home of 180,000
faces about 250 MB: at most 1.5 GB for 20 rooms or five homes in each training process.
"""

SENSORS_KEPT = 2
"""Most recently used sensors kept per scene: a curriculum draws noise for each episode."""

_kept: OrderedDict[tuple[SceneName, int], tuple[Scene, dict[Any, RGBDSensor]]] = OrderedDict()
_lock = RLock()


def get_scene(name: SceneName, seed: int) -> Scene:
    """Get the scene ``name`` with ``seed``, built unless cached."""
    return _place(name, seed)[0]


def get_sensor(
    name: SceneName,
    seed: int,
    intrinsics: Intrinsics,
    noise: str | NoiseConfig,
    device: str = "cpu",
) -> RGBDSensor:
    """Get a sensor in that scene, on ``device``; each environment sets its noise seed."""
    with _lock:
        scene, sensors = _place(name, seed)
        key = intrinsics, noise, device
        sensor = sensors.pop(key, None)
        if sensor is None:
            alike = [
                one
                for (camera, _, where), one in sensors.items()
                if (camera, where) == (intrinsics, device)
            ]
            if alike:
                sensor = alike[0].with_noise(noise)
            else:
                sensor = RGBDSensor(scene, intrinsics, noise, device=device)
        while len(sensors) >= SENSORS_KEPT:
            del sensors[next(iter(sensors))]
        sensors[key] = sensor
        return sensor


def _place(name: SceneName, seed: int) -> tuple[Scene, dict[Any, RGBDSensor]]:
    """Get a scene and its sensors; evict the least recently used if there are too many faces."""
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
