"""The dwelling that tests share, built once a process."""

from __future__ import annotations

from functools import cache

from ms_slam_env import scenes
from ms_slam_env.scenes.homes.home import HomeScene

SEED = 1002


@cache
def home_scene() -> HomeScene:
    scene = scenes.make("home", SEED)
    assert isinstance(scene, HomeScene)
    return scene
