"""Scenes by name."""

from __future__ import annotations

from pathlib import Path

from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.scenes.corridor import corridor
from ms_slam_env.scenes.living_room import living_room
from ms_slam_env.scenes.tabletop_carpet import carpet
from ms_slam_env.scenes.tabletop_table import table
from ms_slam_env.scenes.tabletop_wall import wall
from ms_slam_env.scenes.tabletop_window import window

_MAKERS = {
    "living_room": living_room,
    "corridor": corridor,
    "window": window,
    "table": table,
    "wall": wall,
    "carpet": carpet,
}

SCENES: tuple[str, ...] = tuple(_MAKERS)
"""Names of the procedural scenes; the first is the default."""

SEED_SPLITS: dict[str, range] = {
    "train": range(0, 1000),
    "validation": range(1000, 1100),
    "test": range(2000, 2100),
}
"""Seeds of each split; planners and agents never train on validation or test seeds."""


def split_of(seed: int) -> str | None:
    """Name of the split that ``seed`` belongs to, None if it is in none."""
    return next((name for name, seeds in SEED_SPLITS.items() if seed in seeds), None)


def make(name: str | Path = "living_room", seed: int = 0) -> Scene:
    """Build a scene.

    Args:
        name: one of ``SCENES``.
        seed: varies layout, sizes, colours, textures and lights of a procedural scene.

    Raises:
        InputError: an unknown name.
    """
    if str(name) in _MAKERS:
        return _MAKERS[str(name)](seed)
    valid = ", ".join(SCENES)
    raise InputError(
        f"unknown scene {str(name)!r}; valid choices: {valid}, or the path of a mesh file "
        "(.glb, .obj, .ply)"
    )
