"""A furnished living room: sofa, rug, shelves with books, television, plant, window, pictures."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.furniture import decor, pieces, small_things
from ms_slam_env.scenes.lighting import Lamp, Lighting, Panel, Sun, light_and_expose
from ms_slam_env.scenes.mesh_scene import MeshScene, free_space_around
from ms_slam_env.scenes.room import PANE, Room, Window, floor_material, wall_colour, wall_material
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior

_KEY = 0.18


def living_room(seed: int) -> MeshScene:
    """Build the living room of ``seed``: sofa facing the television, a window to one side."""
    rng = np.random.default_rng([seed, 1])
    room = Room((rng.uniform(4.6, 5.4), rng.uniform(3.8, 4.4), rng.uniform(2.45, 2.75)))
    w, d, h = room.size
    build = MeshBuilder()
    colour = wall_colour(rng)
    plain = wall_material(build, rng, colour, papered=False)
    special = wall_material(build, rng, colour, papered=True)
    shelf_wall = int(rng.choice([1, 3]))
    window_wall = 4 - shelf_wall
    window = Window(rng.uniform(-0.4, 0.4), 0.85, rng.uniform(1.4, 1.9), 1.35)
    walls = (special, plain, plain, plain)
    ceiling = build.material(interior.plaster(rng, (238, 236, 230), 0.7), (2.0, 2.0))
    skirting = build.plain((232, 228, 218))
    room.shell(build, floor_material(build, rng), walls, ceiling, {window_wall: window}, skirting)
    _seating_side(build, rng, room)
    bulb = _television_side(build, rng, room)
    _shelf_side(build, rng, room, shelf_wall)
    _window_side(build, rng, room, window_wall, window)
    with build.frame((w / 2, d / 2, h)):
        decor.ceiling_lamp(build, 0.5, 0.5, "ceiling lamp")
    return _lit(build, rng, seed, room, window_wall, window, bulb)


def _seating_side(build: MeshBuilder, rng: Rng, room: Room) -> None:
    """Sofa at wall 0 with pictures above, rug and coffee table before it, perhaps an armchair."""
    width = rng.uniform(1.8, 2.3)
    along = rng.uniform(-0.3, 0.3)
    with room.at_wall(build, 0, along, gap=0.06):
        pieces.sofa(build, rng, width, 3 if width > 2.0 else 2)
        with build.frame((0, -1.55, 0)):
            decor.rug(build, rng, rng.uniform(2.0, 2.6), rng.uniform(1.4, 1.7))
        table_w, table_d, table_h = rng.uniform(0.9, 1.2), rng.uniform(0.5, 0.65), 0.42
        board = build.material(interior.board(rng), (0.9, 0.9))
        with build.frame((rng.uniform(-0.1, 0.1), -1.3, 0.012)):
            pieces.table(build, table_w, table_d, table_h, board, "coffee table")
            radii = [0.17, 0.15, 0.055, 0.055, 0.15]
            half = table_w / 2
            spots = pieces.place(rng, (-half, -table_d), (half, 0), radii)
            things = (
                lambda: small_things.lying_book(build, rng, "magazine", 0.012),
                lambda: small_things.bowl(build, rng, "bowl"),
                lambda: small_things.cup(build, rng, "cup 0"),
                lambda: small_things.cup(build, rng, "cup 1"),
                lambda: small_things.lying_book(build, rng, "book", 0.03),
            )
            for spot, thing in zip(spots, things, strict=True):
                if spot is not None:
                    with build.frame((*spot, table_h)):
                        thing()
    count = int(rng.integers(2, 4))
    for k in range(count):
        x = along + (k - (count - 1) / 2) * 0.75 + rng.uniform(-0.05, 0.05)
        with room.at_wall(build, 0, x, z=1.62 + rng.uniform(-0.06, 0.06)):
            size = rng.uniform(0.42, 0.62), rng.uniform(0.4, 0.65)
            decor.picture_frame(build, rng, *size, f"picture {k}")
    with build.frame((0.38 if rng.random() < 0.5 else room.size[0] - 0.38, room.size[1] - 0.4, 0)):
        decor.plant(build, rng, rng.uniform(0.9, 1.3), "plant")


def _television_side(build: MeshBuilder, rng: Rng, room: Room) -> Float64:
    """TV stand at wall 2 between a floor lamp and a door; returns the bulb's position (3,)."""
    side = 1 if rng.random() < 0.5 else -1
    along = 0.35 * side
    with room.at_wall(build, 2, along, gap=0.02):
        top = pieces.tv_stand(build, rng, rng.uniform(1.3, 1.6))
        with build.frame((0, 0, top)):
            small_things.television(build, rng, rng.uniform(0.95, 1.2))
    with room.at_wall(build, 2, along, z=1.75):
        decor.picture_frame(build, rng, rng.uniform(0.6, 0.9), 0.4, "picture above TV")
    half = room.length(2) / 2
    paint = np.array([225, 220, 208]) * rng.uniform(0.6, 1.0)
    with room.at_wall(build, 2, -side * (half - 0.75)):
        decor.door(build, rng, "door", paint)
    with room.at_wall(build, 2, -side * (half - 1.4), z=1.1):
        decor.light_switch(build, "light switch")
    place = (side * (half - 0.4), -0.4)
    with room.at_wall(build, 2), build.frame((*place, 0)):
        bulb = decor.floor_lamp(build, 1.5, (250, 236, 205))
    return room.to_world(2, (*place, bulb))


def _shelf_side(build: MeshBuilder, rng: Rng, room: Room, wall: int) -> None:
    """One or two bookshelves and a chest of drawers with things on it and a picture above."""
    side = 1 if rng.random() < 0.5 else -1
    count = int(rng.integers(1, 3))
    for k in range(count):
        with room.at_wall(build, wall, side * (0.95 - 0.96 * k), gap=0.01):
            pieces.bookshelf(build, rng, 0.95, rng.uniform(1.75, 2.1), 5, f"bookshelf {k}")
    along = -side * (1.0 if count == 2 else 0.45)
    height = rng.uniform(0.75, 0.9)
    with room.at_wall(build, wall, along, gap=0.01):
        pieces.drawers(build, rng, 0.8, height, "chest of drawers")
        with build.frame((-0.22, -0.2, height)):
            small_things.vase(build, rng, 0.28, "vase")
        with build.frame((0.2, -0.22, height)):
            small_things.lying_book(build, rng, "book on drawers", 0.04)
    with room.at_wall(build, wall, along, z=1.55):
        decor.picture_frame(build, rng, 0.55, 0.7, "picture over drawers")


def _window_side(build: MeshBuilder, rng: Rng, room: Room, wall: int, window: Window) -> None:
    """Curtains beside the window, a plant on the sill, an armchair and a picture nearby."""
    cloth = decor.curtain_cloth(rng)
    top = window.sill + window.height + 0.15
    for k, side in enumerate((-1, 1)):
        x = window.along + side * (window.width / 2 + 0.12)
        with room.at_wall(build, wall, x, z=top):
            decor.curtain(build, rng, 0.45, top - 0.05, cloth, f"curtain {k}")
    with room.at_wall(build, wall, window.along, z=top), build.object("curtain rod"):
        half = window.width / 2 + 0.45
        build.box((-half, -0.11, 0), (half, -0.09, 0.02), build.plain((70, 58, 48)))
    along = window.along + rng.uniform(-0.4, 0.4)
    with room.at_wall(build, wall, along, z=window.sill, gap=-0.02):
        decor.plant(build, rng, 0.38, "sill plant")
    with room.at_wall(build, wall, rng.uniform(-0.5, 0.2), gap=0.45):
        pieces.sofa(build, rng, 0.85, 1, "armchair")


def _lit(
    build: MeshBuilder,
    rng: Rng,
    seed: int,
    room: Room,
    window_wall: int,
    window: Window,
    bulb: Float64,
) -> MeshScene:
    """Make the scene: daylight, sun or lamps, exposure, start poses."""
    w, d, h = room.size
    day = rng.uniform(0.5, 1.0)
    corner = room.to_world(window_wall, (window.along + window.width / 2, 0.14, window.sill))
    other = room.to_world(window_wall, (window.along - window.width / 2, 0.14, window.sill))
    sky = np.array([0.95, 1.0, 1.08]) * 6.0 * day
    inwards = room.to_world(window_wall, (0, -1, 0)) - room.to_world(window_wall, (0, 0, 0))
    along = room.to_world(window_wall, (1, 0, 0)) - room.to_world(window_wall, (0, 0, 0))
    sun = -inwards + rng.uniform(-0.6, 0.6) * along + [0, 0, rng.uniform(0.6, 1.0)]
    lamp = rng.uniform(0.04, 0.16)
    ceiling = rng.uniform(0.3, 0.9)
    lighting = Lighting(
        lights=(
            # The front of the panel, edge_u x edge_v, faces the room.
            Panel(tuple(other), tuple(corner - other), (0, 0, window.height), tuple(sky), (3, 2)),
            Sun(tuple(sun), tuple(np.array([3.0, 2.7, 2.2]) * rng.uniform(0.0, 1.0))),
            Lamp(tuple(bulb), tuple(np.array([1.0, 0.78, 0.5]) * lamp), 0.08, 3),
            Panel(
                (w / 2 - 0.25, d / 2 + 0.25, h - 0.05),
                (0.5, 0, 0),
                (0, -0.5, 0),
                tuple(np.array([1.0, 0.9, 0.75]) * 8 * ceiling),
                (2, 2),
            ),
        ),
        glow={
            PANE: tuple(sky),
            "lamp shade": (1.6 * lamp + 0.4, 1.3 * lamp + 0.35, 0.9 * lamp + 0.25),
            "TV screen": (0.45, 0.47, 0.5),
            "ceiling lamp": (2 * ceiling + 0.3, 1.9 * ceiling + 0.3, 1.7 * ceiling + 0.3),
        },
        clear=frozenset({PANE, "lamp shade", "ceiling lamp"}),
    )
    centre = np.array([w / 2, d / 2, 1.2])
    mesh, exposure = light_and_expose(build, lighting, centre[None], _KEY)

    def start(draw: Rng) -> tuple[Float64, Float64]:
        eye = np.array([*draw.uniform(0.5, [w - 0.5, d - 0.5]), draw.uniform(1.0, 1.6)])
        target = np.array([*draw.uniform(0.2, [w - 0.2, d - 0.2]), draw.uniform(0.5, 1.1)])
        return eye, target

    free = free_space_around(mesh, centre + np.array([0.0, 0.0, 0.3]))
    return MeshScene(living_room, seed, mesh, free, start, exposure)
