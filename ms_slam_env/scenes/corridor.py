"""A long corridor with doors, pictures and ceiling lamps."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.furniture import decor, pieces, small_things
from ms_slam_env.scenes.lighting import Light, Lighting, Panel, light_and_expose
from ms_slam_env.scenes.mesh_scene import MeshScene, free_space_around
from ms_slam_env.scenes.room import Room, floor_material, wall_colour
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior
from ms_slam_env.scenes.textures.noise import hsv

_KEY = 0.18
_LAMP_SPACING_M = 2.4
_DOOR_SPACING_M = 2.3


def corridor(seed: int) -> MeshScene:
    """Build the corridor of ``seed``: 8 to 10 m long (x), about 1.8 m wide (y)."""
    rng = np.random.default_rng([seed, 2])
    room = Room((rng.uniform(8.0, 10.0), rng.uniform(1.75, 2.0), rng.uniform(2.4, 2.6)))
    build = MeshBuilder()
    colour = wall_colour(rng)
    paint = build.material(interior.plaster(rng, colour), (2.0, 2.0))
    lower = build.material(interior.plaster(rng, 0.72 * colour, 1.3), (1.5, 1.5))
    ceiling = build.material(interior.plaster(rng, (236, 235, 230), 0.7), (2.0, 2.0))
    if rng.random() < 0.5:
        floor = build.material(
            interior.tiles(rng, hsv(0.1, 0.1, rng.uniform(0.5, 0.8))), (1.6, 1.6)
        )
    else:
        floor = floor_material(build, rng)
    trim = build.plain((226, 222, 212))
    room.shell(build, floor, (paint,) * 4, ceiling, skirting=trim)
    _walls(build, rng, room, lower, trim)
    lamps = _lamps(build, rng, room)
    with build.frame((room.size[0] * rng.uniform(0.35, 0.65), room.size[1] / 2, 0)):
        decor.rug(build, rng, rng.uniform(2.0, 3.0), 0.8)
    glow = {f"ceiling lamp {k}": (3.0, 2.9, 2.7) for k in range(len(lamps))}
    lighting = Lighting(tuple(lamps), glow, frozenset(glow))
    w, d, _ = room.size
    line = np.stack([np.linspace(1, w - 1, 5), np.full(5, d / 2), np.full(5, 1.3)], -1)
    mesh, exposure = light_and_expose(build, lighting, line, _KEY)

    def start(draw: Rng) -> tuple[Float64, Float64]:
        # Oblique views: along its axis, most of a corridor is beyond the sensor's range.
        eye = np.array([draw.uniform(0.8, w - 0.8), draw.uniform(0.4, d - 0.4), 0.0])
        eye[2] = draw.uniform(1.1, 1.6)
        ahead = draw.uniform(0.5, 2.2) * draw.choice([-1, 1])
        side = d if draw.random() < 0.5 else 0.0
        return eye, np.array([np.clip(eye[0] + ahead, 0.1, w - 0.1), side, draw.uniform(0.7, 1.4)])

    return MeshScene(corridor, seed, mesh, free_space_around(mesh, line), start, exposure)


def _walls(build: MeshBuilder, rng: Rng, room: Room, lower: Material, trim: Material) -> None:
    """Doors on both long walls and at one end; pictures, notices and furniture between them."""
    length = room.size[0]
    door_paint = hsv(rng.choice([0.08, 0.1, 0.55]), rng.uniform(0.05, 0.5), rng.uniform(0.5, 0.85))
    dado = rng.random() < 0.5
    for wall in (0, 2):
        shift = rng.uniform(-0.5, 0.5)
        doors = np.arange(-length / 2 + 1.1, length / 2 - 0.7, _DOOR_SPACING_M) + shift
        doors = doors[np.abs(doors) < length / 2 - 0.6]
        gaps = (doors[:-1] + doors[1:]) / 2
        for k, along in enumerate(doors):
            with room.at_wall(build, wall, along):
                decor.door(build, rng, f"door {wall}.{k}", door_paint * rng.uniform(0.92, 1.0))
            with room.at_wall(build, wall, along + 0.66, z=1.1):
                decor.light_switch(build, f"light switch {wall}.{k}")
        if dado:
            _dado(build, room, wall, doors, lower, trim)
        for k, along in enumerate(gaps):
            kind = rng.random()
            with room.at_wall(build, wall, along, z=1.55 + rng.uniform(-0.08, 0.08)):
                size = rng.uniform(0.4, 0.75), rng.uniform(0.4, 0.6)
                decor.picture_frame(build, rng, *size, f"picture {wall}.{k}")
            if wall == 2 and kind < 0.6:
                _console(build, rng, room, wall, float(along), k)
    with room.at_wall(build, 1):
        decor.door(build, rng, "end door", door_paint)
    with room.at_wall(build, 3, z=1.5):
        decor.picture_frame(build, rng, 0.7, 0.9, "end picture")
    with room.at_wall(build, 3, 0.0, gap=0.4):
        decor.plant(build, rng, 1.0, "plant")


def _dado(
    build: MeshBuilder, room: Room, wall: int, doors: Float64, lower: Material, trim: Material
) -> None:
    """Darker paint up to a rail at 1 m, interrupted by the doors."""
    half = room.size[0] / 2
    edges = [-half, *np.sort(np.concatenate([doors - 0.52, doors + 0.52])), half]
    for low, high in zip(edges[::2], edges[1::2], strict=True):
        with room.at_wall(build, wall), build.object(f"wall {wall}"):
            build.quad((low, -0.004, 0.08), (high - low, 0, 0), (0, 0, 0.92), lower, (low, 0.0))
        with room.at_wall(build, wall), build.object(f"dado rail {wall}"):
            build.box((low, -0.02, 1.0), (high, 0, 1.04), trim, "Y")


def _console(build: MeshBuilder, rng: Rng, room: Room, wall: int, along: float, k: int) -> None:
    """Chest of drawers, or a chair, against the wall."""
    with room.at_wall(build, wall, along, gap=0.02):
        if rng.random() < 0.6:
            pieces.drawers(build, rng, 0.7, 0.8, f"chest of drawers {k}")
            with build.frame((rng.uniform(-0.2, 0.2), -0.22, 0.8)):
                small_things.vase(build, rng, 0.3, f"vase {k}")
        else:
            pieces.chair(build, rng, f"chair {k}")


def _lamps(build: MeshBuilder, rng: Rng, room: Room) -> list[Light]:
    """Square lamps along the ceiling, of slightly different strength."""
    w, d, h = room.size
    count = max(2, round(w / _LAMP_SPACING_M))
    lights: list[Light] = []
    for k in range(count):
        x = (k + 0.5) * w / count
        with build.frame((x, d / 2, h)):
            decor.ceiling_lamp(build, 0.4, 0.4, f"ceiling lamp {k}")
        radiance = np.array([1.0, 0.95, 0.86]) * 12.0 * rng.uniform(0.5, 1.0)
        lights.append(
            Panel((x - 0.2, d / 2 + 0.2, h - 0.05), (0.4, 0, 0), (0, -0.4, 0), tuple(radiance))
        )
    return lights
