"""What the four table-top settings share: a small room, light, start poses that look at it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.base import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.finishes import floor_material, wall_colour
from ms_slam_env.scenes.furniture import decor
from ms_slam_env.scenes.lighting import Light, Lighting, Panel, auto_exposure, light_mesh
from ms_slam_env.scenes.mesh_scene import MeshScene, StartRule, free_space_around
from ms_slam_env.scenes.room import Room, Window
from ms_slam_env.scenes.textures import masonry

CELL_M = 0.07  # finer light than in a room, for the camera is near


@dataclass(frozen=True)
class Setting:
    """A room under construction.

    Attributes:
        build: collects the geometry.
        room: its size.
        colour: (3,) sRGB paint of the walls.
    """

    build: MeshBuilder
    room: Room
    colour: Float64


def begin(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    floor: Material | None = None,
    windows: dict[int, Window] | None = None,
    wall_contrast: float = 1.0,
    build: MeshBuilder | None = None,
) -> Setting:
    """Start a room of ``size`` with plastered walls."""
    build = build or MeshBuilder(CELL_M)
    colour = wall_colour(rng)
    paint = build.material(masonry.plaster(rng, colour, wall_contrast), (2.0, 2.0))
    ceiling = build.material(masonry.plaster(rng, (238, 236, 230), 0.7), (2.0, 2.0))
    room = Room(size)
    floor = floor or floor_material(build, rng)
    room.shell(build, floor, (paint,) * 4, ceiling, windows, build.plain((230, 226, 216)))
    return Setting(build, room, colour)


def ceiling_light(setting: Setting, rng: np.random.Generator, x: float, y: float) -> Panel:
    """Lamp at the ceiling above (x, y), label "ceiling lamp"."""
    h = setting.room.size[2]
    with setting.build.frame((x, y, h)):
        decor.ceiling_lamp(setting.build, 0.4, 0.4, "ceiling lamp")
    warm = np.array([1.0, rng.uniform(0.84, 0.98), rng.uniform(0.66, 0.95)])
    radiance = tuple(warm * rng.uniform(14.0, 22.0))
    return Panel((x - 0.2, y + 0.2, h - 0.05), (0.4, 0, 0), (0, -0.4, 0), radiance, (3, 3))


def finish(
    setting: Setting,
    name: str,
    seed: int,
    lights: tuple[Light, ...],
    glow: dict[str, tuple[float, float, float]],
    clear: frozenset[str],
    target: ArrayLike,
    start: StartRule,
    key: float = 0.2,
    start_objects: int = 2,
) -> MeshScene:
    """Bake the light, expose for what lies around ``target`` (3,), and return the scene."""
    lighting = Lighting(lights, glow, clear)
    mesh = light_mesh(setting.build.build(), lighting)
    focus = np.asarray(target, dtype=np.float64).reshape(1, 3)
    exposure = auto_exposure(mesh, focus, key, frozenset(glow))
    w, d, h = setting.room.size
    inside = np.array([[w / 2, d / 2, 0.75 * h]])
    free_space = free_space_around(mesh, inside)
    return MeshScene(name, seed, mesh, free_space, start, exposure, start_objects)


def orbit(
    target: ArrayLike,
    towards: ArrayLike,
    distance_m: tuple[float, float] = (0.5, 0.9),
    elevation: tuple[float, float] = (0.3, 0.8),
    azimuth: float = 0.6,
    jitter_m: float = 0.12,
) -> StartRule:
    """Start poses around a setting.

    Args:
        target: (3,) middle of the setting.
        towards: (2,) horizontal direction from the setting to the viewer.
        distance_m: range of the distance to the point looked at.
        elevation: range of the angle above the horizontal, radians.
        azimuth: greatest turn from ``towards``, radians.
        jitter_m: by which the point looked at moves along each axis.
    """
    middle = np.asarray(target, dtype=np.float64)
    base = float(np.arctan2(towards[1], towards[0]))  # type: ignore[index]

    def start(draw: np.random.Generator) -> tuple[Float64, Float64]:
        look = middle + draw.uniform(-jitter_m, jitter_m, 3) * [1, 1, 0.4]
        angle = base + draw.uniform(-azimuth, azimuth)
        rise = draw.uniform(*elevation)
        away = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        return look + draw.uniform(*distance_m) * away, look

    return start
