"""Builds the rooms of a floor plan: floors, walls, doors and furniture."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.furniture import decor
from ms_slam_env.scenes.homes.arrangement import Arrangement, Furnisher, LocalDoor
from ms_slam_env.scenes.homes.floor_plan import (
    DOOR_HEIGHT_M,
    HALL,
    WALL_M,
    Doorway,
    FloorPlan,
    RoomPlan,
)
from ms_slam_env.scenes.homes.furnishing import furnish
from ms_slam_env.scenes.room import Opening, Room, floor_material, wall_colour, wall_material
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric, interior
from ms_slam_env.scenes.textures.noise import hsv

_SHELL_CELL_M = 0.22  # so that vertices lie between door panels, not under them
_TILED = ("kitchen", "bathroom")
_SOFT = ("bedroom", "nursery")  # may have a carpet
_SPECIAL = ("living", "bedroom", "nursery", "study")  # have one wall of wallpaper or brick


def furnished(build: MeshBuilder, rng: Rng, plan: FloorPlan) -> list[Furnisher]:
    """Build the rooms of a plan with their furniture; return each room's furnisher."""
    floors = _Floors(build, rng)
    paint = np.array([225, 220, 208]) * rng.uniform(0.6, 1.0)
    rooms = [_furnished_room(build, rng, plan, index, floors) for index in range(len(plan.rooms))]
    build.cell_m = _SHELL_CELL_M
    for k, door in enumerate(plan.doors):
        _door(build, rng, plan, door, f"door {k}", paint)
    return rooms


class _Floors:
    """Floors, skirting boards and ceiling shared by rooms."""

    def __init__(self, build: MeshBuilder, rng: Rng) -> None:
        self.wood = floor_material(build, rng)
        tone = hsv(rng.choice([0.08, 0.1, 0.55]), rng.uniform(0.05, 0.2), rng.uniform(0.55, 0.85))
        self.tiles = build.material(interior.tiles(rng, tone), (1.4, 1.4))
        self.ceiling = build.material(interior.plaster(rng, (238, 236, 230), 0.7), (2.0, 2.0))
        self.skirting = build.plain((232, 228, 218))

    def of(self, build: MeshBuilder, rng: Rng, kind: str) -> Material:
        """Floor material for a kind of room."""
        if kind in _TILED:
            return self.tiles
        if kind in _SOFT and rng.random() < 0.4:
            pile = hsv(rng.random(), rng.uniform(0.1, 0.4), rng.uniform(0.4, 0.75))
            return build.material(fabric.carpet_pile(rng, pile), (0.8, 0.8))
        return self.wood


def _walls(
    build: MeshBuilder, rng: Rng, kind: str
) -> tuple[Material, Material, Material, Material]:
    """Materials of the four walls, by kind of room."""
    colour = wall_colour(rng)
    if kind == "bathroom":
        tone = hsv(
            rng.choice([0.1, 0.3, 0.5, 0.58]), rng.uniform(0.04, 0.3), rng.uniform(0.75, 0.92)
        )
        glazed = build.material(interior.tiles(rng, tone), (0.8, 0.8))
        return glazed, glazed, glazed, glazed
    plain = wall_material(build, rng, colour, papered=False)
    walls = [plain] * 4
    if kind in _SPECIAL:
        walls[int(rng.integers(4))] = wall_material(build, rng, colour, papered=True)
    return walls[0], walls[1], walls[2], walls[3]


def _furnished_room(
    build: MeshBuilder, rng: Rng, plan: FloorPlan, index: int, floors: _Floors
) -> Furnisher:
    own = plan.rooms[index]
    room = Room((*own.size.tolist(), plan.height))
    windows = dict(own.windows)
    doors = [_local(plan, door, index) for door in plan.doors_of(index)]
    by_wall: dict[int, list[Opening]] = {}
    for door, of_plan in zip(doors, plan.doors_of(index), strict=True):
        if not of_plan.is_entrance:
            by_wall.setdefault(door.wall, []).append(door.opening)
    of = Furnisher(
        build,
        rng,
        own.name,
        own.kind,
        windows,
        doors,
        Arrangement(room, doors, windows),
        [],
        own.kind == "living" and all(one.kind != "kitchen" for one in plan.rooms),
    )
    with build.frame((*own.low, 0)):
        fine, build.cell_m = build.cell_m, _SHELL_CELL_M
        with build.part(own.name):
            walls = _walls(build, rng, own.kind)
            floor = floors.of(build, rng, own.kind)
            room.shell(build, floor, walls, floors.ceiling, windows, floors.skirting, by_wall)
            build.cell_m = fine
            furnish(of)
            with build.frame((room.size[0] / 2, room.size[1] / 2, plan.height)):
                decor.ceiling_lamp(build, *lamp_size(own), "ceiling lamp")
    return of


def lamp_size(room: RoomPlan) -> tuple[float, float]:
    """Width and depth of a room's ceiling lamp, metres; a long lamp in a long room."""
    if room.kind == HALL:
        return (1.4, 0.3) if room.size[0] > room.size[1] else (0.3, 1.4)
    return 0.5, 0.5


def _local(plan: FloorPlan, door: Doorway, index: int) -> LocalDoor:
    """Describe a door from one of its rooms."""
    wall, along = plan.wall_of(door, index)
    hinge = 0
    if door.leaf is not None and door.rooms[door.into] == index:
        hinge = door.hinge if wall in (0, 3) else -door.hinge  # their x has the world's sign
    return LocalDoor(wall, Opening(along, door.width, DOOR_HEIGHT_M), hinge)


def _door(
    build: MeshBuilder, rng: Rng, plan: FloorPlan, door: Doorway, name: str, paint: Float64
) -> None:
    """Add casing, threshold and leaf of a doorway, or the closed entrance door."""
    index = door.rooms[door.into]
    own = plan.rooms[index]
    local = _local(plan, door, index)
    room = Room((*own.size.tolist(), plan.height))
    if not door.is_entrance:
        with build.frame((*door.middle, 0), np.pi / 2 if door.along_x else 0.0):
            decor.doorway(build, rng, name, door.width, WALL_M)
    with build.frame((*own.low, 0)), room.at_wall(build, local.wall, local.opening.along):
        if door.is_entrance:
            decor.door(build, rng, "entrance", paint)
        elif door.leaf is not None:
            with build.frame((local.hinge * door.width / 2, 0, 0)):
                decor.open_leaf(build, rng, name, paint, local.hinge, door.leaf)
