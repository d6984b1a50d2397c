"""Streets and the hall of one seed, each built once for all tests."""

from __future__ import annotations

from functools import cache

from ms_slam_env import scenes
from ms_slam_env.scenes.mesh_scene import LargeScene

SEED = 1000


@cache
def large_scene(name: str) -> LargeScene:
    scene = scenes.make(name, SEED)
    assert isinstance(scene, LargeScene)
    return scene
