"""Scenes by name."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ms_slam_env._runtime.extension import ExtensionPoint, load_reference
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.scenes.mesh_formats import MESH_SUFFIXES, MeshFile
from ms_slam_env.scenes.scene import Scene

_ROOMS = {
    "living_room": "ms_slam_env.scenes.living_room:living_room",
    "corridor": "ms_slam_env.scenes.corridor:corridor",
    **{
        name: f"ms_slam_env.scenes.tabletops:{name}"
        for name in ("window", "table", "wall", "carpet")
    },
}

_HOMES = {"home": "ms_slam_env.scenes.homes.home:home"}

_LARGE = {
    name: f"ms_slam_env.scenes.{name}:{name}"
    for name in ("residential_street", "city_street", "factory_hall")
}
_MESH_FILE = "ms_slam_env.scenes.mesh_file:from_file"  # if the name is that of a file

POINT = ExtensionPoint(
    "scene",
    "ms_slam_env.scenes",
    own={**_ROOMS, **_HOMES, **_LARGE},
    form="module:function",
    takes=("seed",),
)

ROOMS: tuple[str, ...] = tuple(_ROOMS)
"""Names of room-sized scenes."""

PUBLISHED_ROOMS = ("living_room", "corridor", "window", "table", "wall", "carpet")
"""Default rooms of published commands; adding a room does not change their results."""

HOMES: tuple[str, ...] = tuple(_HOMES)
"""Names of multi-room scenes: slow to build the first time (10 s), then cached on disk."""

LARGE_SCENES: tuple[str, ...] = tuple(_LARGE)
"""Names of the streets and the hall: larger than a Kinect's range, slow to build (5 to 12 s)."""

SCENES: tuple[str, ...] = tuple(POINT.own)
"""Names of the procedural scenes; the first is the default."""

SEED_SPLITS: dict[str, range] = {
    "train": range(0, 1000),
    "validation": range(1000, 1100),
    "test": range(2000, 2100),
}
"""Seeds of each split; planners and agents never train on validation or test seeds."""


_OWN_SEEDS = re.compile(r"[0-9]{1,10}(-[0-9]{1,10})?(,[0-9]{1,10}(-[0-9]{1,10})?)*")
_MOST_OWN_SEEDS = 100_000


def seeds_of(text: str) -> Sequence[int]:
    """Parse the name of a split, or numbers and ranges, as 7000-7003 or 7000,7005,8000-8009.

    Raises:
        InputError: neither a split nor such numbers; more than 100,000, or a repeated one.
    """
    if isinstance(text, str) and text in SEED_SPLITS:
        return SEED_SPLITS[text]
    if not isinstance(text, str) or not _OWN_SEEDS.fullmatch(text):
        own = "seeds of your own, as 7000-7003 or 7000,7005"
        raise unknown("split of seeds", text, (*SEED_SPLITS, own))
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        more = range(int(first), int(last or first) + 1)
        if not more or len(found) + len(more) > _MOST_OWN_SEEDS:
            raise InputError(f"seeds {text[:80]!r}: {part} is not a range of 1 to 100,000 seeds")
        found += more
    if len(set(found)) < len(found):
        raise InputError(f"seeds {text[:80]!r} names one twice")
    return found


def split_of(seed: int) -> str | None:
    """Name of the split that ``seed`` belongs to, or None."""
    return next((name for name, seeds in SEED_SPLITS.items() if seed in seeds), None)


SceneName = str | Callable[[int], Scene]
"""A scene's name, the path of a mesh file, or a function of the seed."""


def is_mesh_file(name: object) -> bool:
    """Whether ``name`` denotes a mesh file.

    Raises:
        InputError: it does, but with unknown options.
    """
    return MeshFile.named(name) is not None


def check_name(name: object) -> None:
    """Refuse anything but the name of a scene or an existing mesh file.

    Raises:
        InputError: it lists the valid choices.
    """
    if (file := MeshFile.named(name)) is not None:
        file.check_exists()
    elif isinstance(name, str) and ":" not in name and name not in POINT.names():
        raise POINT.unknown(name, (f"the path of a mesh file ({', '.join(MESH_SUFFIXES)})",))
    elif name not in SCENES:  # built-in scenes need no check; importing one takes a while
        POINT.find(name)


def name_of(scene: SceneName) -> str:
    """A scene's name; for a function, the function's name."""
    return str(getattr(scene, "__name__", scene))


def make(name: SceneName | Path = "living_room", seed: int = 0) -> Scene:
    """Build a scene; the same name and seed give the same scene, bit for bit.

    Args:
        name: one of ``SCENES``, an entry point (group ``ms_slam_env.scenes``) or
            ``module:function``, a function of the seed, or a mesh file, such as ``room.obj`` or
            ``room.glb,up=z``.
        seed: varies layout, sizes, colours, textures and lights of a procedural scene, or the lamps
            of a mesh file; not negative.

    Raises:
        InputError: an unknown name, a bad seed, a mesh file that is missing, unreadable, without
            triangles or without free space.
    """
    if not isinstance(seed, (int, np.integer)) or isinstance(seed, bool) or seed < 0:
        raise InputError(f"scene seed {seed!r} must be an integer >= 0")
    key = str(name) if isinstance(name, Path) else name
    check_name(key)
    if is_mesh_file(key):
        read: Callable[[str, int], Scene] = load_reference(_MESH_FILE)
        return read(str(key), int(seed))
    scene = POINT.find(key)(int(seed))
    if not isinstance(scene, Scene):
        raise InputError(f"scene {name!r} made {type(scene).__name__}, no ms_slam_env.scenes.Scene")
    return scene
