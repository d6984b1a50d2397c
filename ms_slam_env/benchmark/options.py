"""Options of the environment as text: ``lookahead.reference=live``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ms_slam_env.config import nested_options
from ms_slam_env.env.config import make_config
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam import BACKENDS
from ms_slam_env.slam.frame_selection import FrameSelectionConfig
from ms_slam_env.slam.frame_selection import make_config as make_frame_management

OWN_OPTIONS = (
    *("scene", "scene_seed", "split", "observation", "step_m", "step_rad"),
    *("render_mode", "max_episode_steps"),
)
"""Options of ``gym.make`` that an episode has other options for, or that its planner decides."""


def parse_frame_management(text: str) -> FrameSelectionConfig:
    """The frame management ``NAME,option=value,...``; nested options as in ``change.width=40``.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    name, *parts = text.split(",")
    return make_frame_management(name, **nested_options(parts))


def parse_options(texts: Sequence[str]) -> dict[str, Any]:
    """Nested mapping of ``EnvConfig``, and ``embodiment``, from texts ``name.name=value``.

    Values are YAML.

    Raises:
        InputError: no ``=``, an unknown name (the message lists the valid ones), a value out of
            range, or a name that the benchmark sets itself.
    """
    result = nested_options(texts)
    for name in result:
        if name in OWN_OPTIONS:
            raise InputError(f"option {name!r} is not free: the benchmark sets it")
    embodiment = result.get("embodiment", next(iter(EMBODIMENTS)))
    if embodiment not in EMBODIMENTS:
        raise unknown("embodiment", embodiment, EMBODIMENTS)
    configured = {name: value for name, value in result.items() if name != "embodiment"}
    backend = make_config(configured, ("embodiment",), OWN_OPTIONS).slam
    if backend not in BACKENDS:
        raise unknown("SLAM backend", backend, BACKENDS)
    return result
