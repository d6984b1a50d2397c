"""An environment that is made and stepped quickly."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

import ms_slam_env  # noqa: F401 -- registers the environments

FREE, ROOM = "MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-Room-v0"


def small_env(env_id: str = FREE, **options: Any) -> gym.Env[Any, Any]:
    """A table at 80x60, without the checker, which takes a step of its own."""
    own = {"scene": "table", "scene_seed": 0, "image_size": "80x60"}
    return gym.make(env_id, disable_env_checker=True, **{**own, **options})
