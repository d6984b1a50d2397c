"""The paper's four table-top settings: carpet, table, wall and window, each in a small room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.furniture import decor, pieces, small_things
from ms_slam_env.scenes.lighting import Light, Lighting, Panel, Sun, light_and_expose
from ms_slam_env.scenes.mesh_scene import MeshScene, SceneMaker, StartRule, free_space_around
from ms_slam_env.scenes.room import PANE, Room, Window, floor_material, wall_colour
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric, interior
from ms_slam_env.scenes.textures.noise import hsv

_LAMP_GLOW = {"ceiling lamp": (4.0, 3.8, 3.4)}
_CLEAR = frozenset({"ceiling lamp", PANE})  # cast no shadow
CELL_M = 0.07  # finer light than in a room, because the camera is near


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
    rng: Rng,
    size: tuple[float, float, float],
    floor: Material | None = None,
    windows: dict[int, Window] | None = None,
    wall_contrast: float = 1.0,
    build: MeshBuilder | None = None,
) -> Setting:
    """Start a room of ``size`` with plastered walls."""
    build = build or MeshBuilder(CELL_M)
    colour = wall_colour(rng)
    paint = build.material(interior.plaster(rng, colour, wall_contrast), (2.0, 2.0))
    ceiling = build.material(interior.plaster(rng, (238, 236, 230), 0.7), (2.0, 2.0))
    room = Room(size)
    floor = floor or floor_material(build, rng)
    room.shell(build, floor, (paint,) * 4, ceiling, windows, build.plain((230, 226, 216)))
    return Setting(build, room, colour)


def ceiling_light(setting: Setting, rng: Rng, x: float, y: float) -> Panel:
    """Add a ceiling lamp above (x, y), with the label "ceiling lamp"."""
    h = setting.room.size[2]
    with setting.build.frame((x, y, h)):
        decor.ceiling_lamp(setting.build, 0.4, 0.4, "ceiling lamp")
    warm = np.array([1.0, rng.uniform(0.84, 0.98), rng.uniform(0.66, 0.95)])
    radiance = tuple(warm * rng.uniform(14.0, 22.0))
    return Panel((x - 0.2, y + 0.2, h - 0.05), (0.4, 0, 0), (0, -0.4, 0), radiance, (3, 3))


def finish(
    setting: Setting,
    maker: SceneMaker,
    seed: int,
    lights: tuple[Light, ...],
    glow: dict[str, tuple[float, float, float]],
    target: ArrayLike,
    start: StartRule,
    key: float = 0.2,
    start_objects: int = 2,
) -> MeshScene:
    """Bake the light, expose for the surroundings of ``target`` (3,), and return the scene."""
    focus = np.asarray(target, dtype=np.float64).reshape(1, 3)
    mesh, exposure = light_and_expose(setting.build, Lighting(lights, glow, _CLEAR), focus, key)
    w, d, h = setting.room.size
    inside = np.array([[w / 2, d / 2, 0.75 * h]])
    free = free_space_around(mesh, inside)
    return MeshScene(maker, seed, mesh, free, start, exposure, start_objects)


def orbit(
    target: ArrayLike,
    distance_m: tuple[float, float] = (0.5, 0.9),
    elevation: tuple[float, float] = (0.3, 0.8),
    azimuth: float = 0.6,
    jitter_m: float = 0.12,
) -> StartRule:
    """Start poses around a setting.

    Args:
        target: (3,) centre of the setting.
        distance_m: range of the distance to the point looked at.
        elevation: range of the angle above the horizontal, radians.
        azimuth: largest rotation away from the front, -y, radians.
        jitter_m: largest shift of the point looked at, per axis.
    """
    middle = np.asarray(target, dtype=np.float64)

    def start(draw: Rng) -> tuple[Float64, Float64]:
        look = middle + draw.uniform(-jitter_m, jitter_m, 3) * [1, 1, 0.4]
        angle = -np.pi / 2 + draw.uniform(-azimuth, azimuth)
        rise = draw.uniform(*elevation)
        away = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        return look + draw.uniform(*distance_m) * away, look

    return start


_TILE_M = 0.4  # the pile repeats after this


def carpet(seed: int) -> MeshScene:
    """Build the carpet of ``seed``: pile from wall to wall, furniture only at the walls."""
    rng = np.random.default_rng([seed, 6])
    build = MeshBuilder(CELL_M)
    colour = hsv(
        rng.choice([0.08, 0.1, 0.33, 0.58, 0.62, 0.95]),
        rng.uniform(0.08, 0.4),
        rng.uniform(0.4, 0.65),
    )
    pile = build.material(fabric.carpet_pile(rng, colour), (_TILE_M, _TILE_M))
    size = (rng.uniform(3.4, 4.0), rng.uniform(3.2, 3.6), 2.5)
    setting = begin(rng, size, floor=pile, build=build)
    room = setting.room
    w, d, _ = room.size
    with room.at_wall(build, 0, 0.0, gap=0.05):
        pieces.sofa(build, rng, 1.8, 2)
    with room.at_wall(build, 3, 0.2, gap=0.01):
        pieces.bookshelf(build, rng, 0.9, 1.8, 5)
    with room.at_wall(build, 1, 0.0, z=1.5):
        decor.picture_frame(build, rng, 0.7, 0.5, "picture")
    target = np.array([w / 2, 0.42 * d, 0.0])
    where = target + np.array(
        [rng.uniform(0.55, 0.75) * rng.choice([-1, 1]), rng.uniform(-0.3, 0.3), 0.0]
    )
    with build.frame(where):
        small_things.lying_book(build, rng, "magazine", 0.01)
    lamp = ceiling_light(setting, rng, w / 2, d / 2)
    start = orbit(target, (0.6, 0.9), elevation=(0.8, 1.3), azimuth=np.pi, jitter_m=0.3)
    return finish(
        setting, carpet, seed, (lamp,), _LAMP_GLOW, target, start, key=0.22, start_objects=1
    )


def table(seed: int) -> MeshScene:
    """Build the table of ``seed`` with books, cups, plates, a laptop and more on it."""
    rng = np.random.default_rng([seed, 3])
    setting = begin(rng, (rng.uniform(3.0, 3.6), rng.uniform(2.9, 3.4), 2.5))
    build, room = setting.build, setting.room
    w, d, _ = room.size
    width, depth, height = rng.uniform(1.3, 1.6), rng.uniform(0.75, 0.9), rng.uniform(0.72, 0.76)
    gap = rng.uniform(0.25, 0.5)
    board = build.material(interior.board(rng), (1.0, 1.0))
    with room.at_wall(build, 0, gap=gap):
        pieces.table(build, width, depth, height, board)
        with build.frame((0, 0, height)):
            clutter(build, rng, width, depth)
    with room.at_wall(build, 0, rng.uniform(-0.3, 0.3), z=1.5):
        decor.picture_frame(build, rng, 0.7, 0.5, "picture 0")
    with room.at_wall(build, 3, 0.3, gap=0.01):
        pieces.bookshelf(build, rng, 0.9, 1.8, 5)
    with room.at_wall(build, 1, 0.0, z=1.5):
        decor.picture_frame(build, rng, 0.5, 0.6, "picture 1")
    with build.frame((w - 0.4, d - 0.4, 0)):
        decor.plant(build, rng, 1.1, "plant")
    with build.frame((w / 2 + rng.uniform(-0.3, 0.3), d - gap - depth - 0.2, 0), yaw=np.pi):
        pieces.chair(build, rng)
    lamp = ceiling_light(setting, rng, w / 2 + rng.uniform(-0.4, 0.4), d - gap - 0.5)
    glow = {**_LAMP_GLOW, "laptop screen": (0.5, 0.5, 0.52)}
    target = (w / 2, d - gap - depth / 2, height)
    start = orbit(target, elevation=(0.4, 0.9), jitter_m=0.2)
    return finish(setting, table, seed, (lamp,), glow, target, start)


def clutter(build: MeshBuilder, rng: Rng, width: float, depth: float) -> None:
    """Place objects on the rectangle [-width/2, width/2] x [-depth, 0] at z = 0."""
    with build.frame((rng.uniform(-0.2, 0.2), -0.3 * depth, 0), yaw=rng.uniform(-0.25, 0.25)):
        small_things.laptop(build, rng, "laptop")
    makers: dict[str, tuple[Callable[..., None], float]] = {
        "plate": (small_things.plate, 0.14),
        "bowl": (small_things.bowl, 0.15),
        "book": (partial(small_things.lying_book, thick_m=0.03), 0.14),
        "cup": (small_things.cup, 0.05),
        "bottle": (small_things.bottle, 0.045),
        "pens": (small_things.pen_pot, 0.045),
        "paper": (small_things.paper, 0.14),
        "vase": (partial(small_things.vase, height_m=0.22), 0.07),
        "magazine": (partial(small_things.lying_book, thick_m=0.008), 0.14),
        "second cup": (small_things.cup, 0.05),
    }
    names = list(makers)
    front = -0.3 * depth - 0.27  # the laptop stands behind this line, at the centre
    regions = {
        "left": ((-width / 2, -depth), (-0.2, 0.0)),
        "right": ((0.2, -depth), (width / 2, 0.0)),
        "front": ((-0.2, -depth), (0.2, front)),
    }
    for side, (low, high) in regions.items():
        order = [names[k] for k in rng.permutation(len(names))]
        spots = pieces.place(rng, low, high, [makers[n][1] for n in order])
        for name, spot in zip(order, spots, strict=True):
            if spot is not None:
                with build.frame((*spot, 0.0), yaw=rng.uniform(-np.pi, np.pi)):
                    makers[name][0](build, rng, name=f"{name} {side}")


_CONTRAST = 0.35  # of the plaster; 1 is an ordinary wall


def wall(seed: int) -> MeshScene:
    """Build the wall of ``seed``: one or two pictures, a switch, a shelf, the rest bare."""
    rng = np.random.default_rng([seed, 5])
    size = (rng.uniform(3.6, 4.2), rng.uniform(2.6, 3.0), 2.5)
    setting = begin(rng, size, wall_contrast=_CONTRAST)
    build, room = setting.build, setting.room
    w, d, _ = room.size
    side = float(rng.choice([-1, 1]))
    with room.at_wall(build, 0, side * rng.uniform(0.25, 0.45), z=rng.uniform(1.35, 1.5)):
        decor.picture_frame(build, rng, rng.uniform(0.35, 0.5), rng.uniform(0.3, 0.45), "picture 0")
    if rng.random() < 0.5:
        with room.at_wall(build, 0, side * rng.uniform(1.0, 1.3), z=1.45):
            decor.picture_frame(build, rng, 0.3, 0.4, "picture 1")
    with room.at_wall(build, 0, -side * rng.uniform(0.3, 0.5), z=1.1):
        decor.light_switch(build, "light switch")
    with room.at_wall(build, 0, -side * rng.uniform(1.1, 1.3), z=rng.uniform(1.25, 1.5)):
        pieces.wall_shelf(build, rng, 0.6)
    with room.at_wall(build, 2, side * 0.6, gap=0.01):
        pieces.bookshelf(build, rng, 0.9, 1.8, 5)
    with build.frame((0.4, 0.4, 0)):
        decor.plant(build, rng, 1.0, "plant")
    lamp = ceiling_light(setting, rng, w / 2 + rng.uniform(-0.8, 0.8), d - 1.3)
    target = (w / 2, d, 1.25)
    start = orbit(target, (0.55, 0.9), elevation=(-0.15, 0.25), azimuth=0.35, jitter_m=0.4)

    def on_wall(draw: Rng) -> tuple[Float64, Float64]:
        eye, look = start(draw)
        look[1] = d
        return eye, look

    return finish(
        setting, wall, seed, (lamp,), _LAMP_GLOW, target, on_wall, key=0.3, start_objects=1
    )


_SKY = 9.0  # radiance of the sky in the units of the baked light; the desk gets 1 to 2


def window(seed: int) -> MeshScene:
    """Build the window of ``seed``: the pane saturates the sensor, objects on the sill are dark."""
    rng = np.random.default_rng([seed, 4])
    height = rng.uniform(0.72, 0.76)
    opening = Window(
        rng.uniform(-0.2, 0.2), height + rng.uniform(0.12, 0.22), rng.uniform(1.2, 1.6), 1.25
    )
    size = (rng.uniform(2.8, 3.4), rng.uniform(2.8, 3.3), 2.55)
    setting = begin(rng, size, windows={0: opening})
    build, room = setting.build, setting.room
    w, d, _ = room.size
    width, depth = rng.uniform(1.3, 1.6), rng.uniform(0.62, 0.75)
    board = build.material(interior.board(rng), (1.0, 1.0))
    with room.at_wall(build, 0, opening.along, gap=0.13):
        pieces.table(build, width, depth, height, board, "desk")
        with build.frame((0, 0, height)):
            side = rng.choice([-1, 1])
            with build.frame((side * 0.3, -0.2, 0), yaw=rng.uniform(-0.2, 0.2)):
                small_things.laptop(build, rng, "laptop")
            with build.frame((-side * 0.25, -0.25, 0)):
                small_things.paper(build, rng, "paper")
            with build.frame((-side * 0.5, -0.3, 0)):
                small_things.lying_book(build, rng, "book", 0.035)
            with build.frame((-side * 0.08, -0.15, 0), yaw=1.0):
                small_things.cup(build, rng, "cup")
            with build.frame((side * 0.58, -0.35, 0)):
                small_things.pen_pot(build, rng, "pens")
    sill = [x for x in np.linspace(-opening.width / 2 + 0.15, opening.width / 2 - 0.15, 4)]
    with room.at_wall(build, 0, opening.along, z=opening.sill):
        for k, x in enumerate(sill):
            with build.frame((x + rng.uniform(-0.05, 0.05), -0.02, 0)):
                kind = rng.integers(3)
                if kind == 0:
                    decor.plant(build, rng, rng.uniform(0.3, 0.42), f"sill plant {k}")
                elif kind == 1:
                    small_things.vase(build, rng, rng.uniform(0.14, 0.24), f"sill vase {k}")
                else:
                    small_things.bottle(build, rng, f"sill bottle {k}")
    cloth = decor.curtain_cloth(rng)
    top = opening.sill + opening.height + 0.12
    for k, side in enumerate((-1, 1)):
        x = opening.along + side * (opening.width / 2 + 0.16)
        with room.at_wall(build, 0, x, z=top):
            decor.curtain(build, rng, 0.4, top - height - 0.02, cloth, f"curtain {k}")
    for wall in (1, 3):
        with room.at_wall(build, wall, rng.uniform(-0.3, 0.3), z=1.5):
            decor.picture_frame(build, rng, 0.6, 0.5, f"picture {wall}")
    a = opening.along - opening.width / 2
    corner = room.to_world(0, (a, 0.14, opening.sill))
    along = room.to_world(0, (a + opening.width, 0.14, opening.sill)) - corner
    sky = (_SKY * 0.93, _SKY, _SKY * 1.08)
    lights = (
        Panel(tuple(corner), tuple(along), (0, 0, opening.height), sky, (4, 3)),
        Sun((rng.uniform(-0.5, 0.5), 1.0, rng.uniform(0.9, 1.3)), (4.0, 3.7, 3.1)),
    )
    target = np.array([w / 2 + opening.along, d - 0.4, height + 0.12])
    start = orbit(target, elevation=(0.05, 0.6), azimuth=0.7, jitter_m=0.2)
    glow = {PANE: sky, "laptop screen": (1.0, 1.0, 1.05)}
    return finish(setting, window, seed, lights, glow, target, start, key=0.2)
