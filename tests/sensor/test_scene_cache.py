"""Scenes are built once while they are kept; the ones longest not asked for go first."""

from copy import copy
from types import SimpleNamespace

import pytest

from ms_slam_env.camera import xtion
from ms_slam_env.sensor import scene_cache


class Sensor:
    made = 0

    def __init__(self, scene, intrinsics, noise, device="cpu"):
        self.noise = noise
        Sensor.made += 1

    def with_noise(self, noise):
        made = copy(self)
        made.noise = noise
        return made


@pytest.fixture
def built(monkeypatch):
    """The (name, seed) of every scene built; a scene has as many faces as its seed says."""
    made = []

    def make(name, seed):
        made.append((name, seed))
        return SimpleNamespace(mesh=SimpleNamespace(faces=range(seed)))

    monkeypatch.setattr(scene_cache, "_kept", type(scene_cache._kept)())
    monkeypatch.setattr(scene_cache, "FACES_KEPT", 100)
    monkeypatch.setattr(scene_cache.scenes, "make", make)
    monkeypatch.setattr(scene_cache, "RGBDSensor", Sensor)
    return made


def test_a_scene_is_built_once_while_it_is_kept(built):
    first = scene_cache.get_scene("room", 40)
    assert scene_cache.get_scene("room", 40) is first
    assert scene_cache.get_scene("room", 41) is not first
    assert built == [("room", 40), ("room", 41)]


def test_the_one_longest_not_asked_for_goes(built):
    for seed in (40, 41, 40, 42):  # 123 faces
        scene_cache.get_scene("room", seed)
    scene_cache.get_scene("room", 40)
    assert built == [("room", 40), ("room", 41), ("room", 42)]
    scene_cache.get_scene("room", 41)
    assert built[-1] == ("room", 41)


def test_one_that_is_too_large_is_kept_alone(built):
    scene_cache.get_scene("room", 40)
    first = scene_cache.get_scene("home", 500)
    assert scene_cache.get_scene("home", 500) is first
    assert list(scene_cache._kept) == [("home", 500)]


def test_a_sensor_lives_as_long_as_its_scene(built):
    camera = xtion("80x60")
    first = scene_cache.get_sensor("room", 60, camera, "kinect")
    assert scene_cache.get_sensor("room", 60, camera, "kinect") is first
    assert scene_cache.get_sensor("room", 60, camera, "none") is not first
    assert scene_cache.get_sensor("room", 60, xtion("160x120"), "kinect") is not first
    scene_cache.get_scene("room", 61)
    assert scene_cache.get_sensor("room", 60, camera, "kinect") is not first


def test_drawn_noise_keeps_two_sensors_that_look_at_one_copy_of_the_scene(built):
    before, camera = Sensor.made, xtion("80x60")
    sensors = [scene_cache.get_sensor("room", 60, camera, k) for k in range(9)]
    assert [sensor.noise for sensor in sensors] == list(range(9))
    assert Sensor.made == before + 1
    assert scene_cache.get_sensor("room", 60, camera, 8) is sensors[8]
    ((_, kept),) = scene_cache._kept.values()
    assert list(kept.values()) == [sensors[7], sensors[8]]
