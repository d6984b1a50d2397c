"""Options of the environment as text: ``lookahead.reference=live``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml

from ms_slam_env.env.config import make_config
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam import BACKENDS
from ms_slam_env.slam.frame_management import FrameManagementConfig
from ms_slam_env.slam.frame_management import make_config as make_frame_management

OWN_OPTIONS = (
    *("scene", "scene_seed", "split", "observation", "step_m", "step_rad"),
    *("render_mode", "max_episode_steps"),
)
"""Options of ``gym.make`` that an episode has other options for, or that its planner decides."""


def parse_value(text: str, name: str) -> Any:
    """The YAML value of option ``name``.

    Raises:
        InputError: text that is not YAML.
    """
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise InputError(f"option {name!r}: {text!r} is not a YAML value") from None


def parse_named(text: str, kind: str) -> tuple[str, dict[str, Any]]:
    """Split ``NAME,option=value,...`` into the name and the options; values are YAML scalars.

    Args:
        text: to be split.
        kind: of thing that has this name, for the error message.

    Raises:
        InputError: an option without ``=``, or a value that is not YAML.
    """
    name, *parts = text.split(",")
    options = {}
    for part in parts:
        option, equals, value = part.partition("=")
        if not equals or not option.isidentifier():
            raise InputError(f"{kind} {text!r}: {part!r} is not option=value")
        options[option] = parse_value(value, option)
    return name, options


def parse_frame_management(text: str) -> FrameManagementConfig:
    """The frame management ``NAME,option=value,...``; nested options as in ``change.width=40``.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    name, *parts = text.split(",")
    return make_frame_management(name, **nested_options(parts))


def nested_options(texts: Sequence[str]) -> dict[str, Any]:
    """Nested mapping from texts ``name.name=value``; values are YAML.

    Raises:
        InputError: no ``=``, a value that is not YAML, or a name that is value and mapping.
    """
    result: dict[str, Any] = {}
    for text in texts:
        path, equals, value = text.partition("=")
        *parents, name = path.split(".")
        if not equals:
            raise InputError(f"option {text!r} is not name=value")
        inner = result
        for parent in parents:
            inner = inner.setdefault(parent, {})
            if not isinstance(inner, dict):
                raise InputError(f"option {path!r}: {parent} already has a value")
        inner[name] = parse_value(value, path)
    return result


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
