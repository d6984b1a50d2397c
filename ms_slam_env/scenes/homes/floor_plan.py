"""Floor plans of homes: rooms along a hall, doors between them, windows to the outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.room import Room, Window
from ms_slam_env.scenes.scene import Rng

WALL_M = 0.12
"""Thickness of the walls between rooms."""
DOOR_HEIGHT_M = 2.05
ROOMS_M = (3, 7)
"""Fewest and most rooms besides the hall."""
AREA_M2 = (40.0, 120.0)
"""Smallest and largest floor area, without walls."""

HALL = "hall"
_AREA_M2 = {
    "living": (17.0, 25.0),
    "kitchen": (8.5, 13.0),
    "bedroom": (11.0, 15.0),
    "bathroom": (5.0, 7.5),
    "study": (8.0, 11.0),
    "nursery": (9.5, 13.0),
}
KINDS = (*_AREA_M2, HALL)
"""Kinds of rooms; a second bedroom is called ``bedroom2``."""

_OF_SMALL_HOMES = ("living", "bedroom", "bathroom", "kitchen")
_FURTHER = ("study", "nursery", "bedroom2")
_LEAST_M = {"bathroom": 1.9, "kitchen": 2.3, "study": 2.3}  # 2.6 for the others
_HALL_M = (1.55, 1.85)
_LAYOUTS = 60  # tried; the best is used
_CASING_M = 0.1
_CORNER_M = 0.2  # between a casing and the corner of the room
DOOR_M = 0.9
"""Width of a doorway with a leaf."""
_WIDE_M = (1.1, 1.6)


@dataclass(frozen=True)
class Doorway:
    """An opening in the wall between two rooms, or a closed door to the outside.

    Attributes:
        middle: (x, y) of its floor's centre, in the middle of the wall; for the entrance, at the
            wall's face.
        along_x: whether the way through it is along x.
        rooms: indices of the rooms on its low and high side; the entrance has only one.
        width: metres.
        leaf: angle in radians by which the leaf is open into room ``rooms[into]``; None: no leaf.
        into: 0 or 1, index into ``rooms`` of the room that the leaf opens into.
        hinge: -1 or 1: the end along the wall where the leaf hangs.
    """

    middle: tuple[float, float]
    along_x: bool
    rooms: tuple[int, ...]
    width: float
    leaf: float | None = None
    into: int = 0
    hinge: int = 1

    @property
    def is_entrance(self) -> bool:
        """Whether it is the home's closed outer door."""
        return len(self.rooms) == 1

    def side(self, room: int) -> float:
        """+1 if ``room`` is on its high side, -1 if on its low side."""
        return 1.0 if self.rooms.index(room) == 1 else -1.0


@dataclass(frozen=True)
class RoomPlan:
    """A room.

    Attributes:
        name: unique name in the home.
        kind: one of ``KINDS``.
        low: lower corner (x, y) of its floor, metres.
        high: upper corner.
        windows: windows by wall, numbered as in ``Room``.
    """

    name: str
    kind: str
    low: tuple[float, float]
    high: tuple[float, float]
    windows: tuple[tuple[int, Window], ...] = ()

    @property
    def size(self) -> Float64:
        """Width and depth (2,), metres."""
        return np.subtract(self.high, self.low)

    @property
    def area(self) -> float:
        """Floor area, square metres."""
        return float(np.prod(self.size))


@dataclass(frozen=True)
class FloorPlan:
    """Rooms, the hall last, and the doors between them."""

    rooms: tuple[RoomPlan, ...]
    doors: tuple[Doorway, ...]
    height: float

    @property
    def area(self) -> float:
        """Total floor area, square metres."""
        return sum(room.area for room in self.rooms)

    def doors_of(self, room: int) -> list[Doorway]:
        """The doors in the walls of a room."""
        return [door for door in self.doors if room in door.rooms]

    def wall_of(self, door: Doorway, room: int) -> tuple[int, float]:
        """The wall of ``room`` that a door is in, and its position along it, as in ``Room``."""
        own = self.rooms[room]
        box = Room((*own.size, self.height))
        middle = np.array(door.middle) - own.low
        of_axis = (1, 3) if door.along_x else (0, 2)
        axis = 0 if door.along_x else 1
        wall = of_axis[0] if middle[axis] > own.size[axis] / 2 else of_axis[1]
        origin, yaw = box.wall_frame(wall)
        return wall, float((middle - origin[:2]) @ [np.cos(yaw), np.sin(yaw)])


def draw_plan(rng: Rng) -> FloorPlan:
    """Draw a home of 3 to 7 rooms and a hall.

    The rooms form one or two rows along the hall, with widths according to their areas; the living
    room may instead span the end of hall and rows.
    """
    count = int(rng.integers(ROOMS_M[0], ROOMS_M[1] + 1))
    kinds = [*_OF_SMALL_HOMES[:count], *rng.permutation(_FURTHER)[: max(0, count - 4)].tolist()]
    layouts = (_layout(rng, kinds) for _ in range(_LAYOUTS))
    rooms = min(layouts, key=_awkwardness)
    rooms = _turned(rng, rooms)
    rooms = tuple(_with_windows(rng, rooms, k) for k in range(len(rooms)))
    return FloorPlan(rooms, _doors(rng, rooms), float(rng.uniform(2.45, 2.65)))


def _layout(rng: Rng, kinds: Sequence[str]) -> tuple[RoomPlan, ...]:
    """Draw an arrangement of the rooms, good or bad, with the hall along x."""
    area = {kind: rng.uniform(*_AREA_M2[_kind(kind)]) for kind in kinds}
    if len(kinds) == 3:
        area["living"] += rng.uniform(4.0, 9.0)  # the kitchen is in it
    rest = rng.permutation(list(kinds)).tolist()
    at_end = len(kinds) > 3 and rng.random() < 0.5
    if at_end:
        rest.remove("living")
    upper = rest[: int(rng.integers(1, len(rest)))]
    lower = rest[len(upper) :]
    hall = rng.uniform(*_HALL_M)
    areas = [sum(area[kind] for kind in row) for row in (lower, upper)]
    length = sum(areas) / rng.uniform(4.5, 8.5)
    depths = [of_row / length for of_row in areas]
    y = (0.0, depths[0] + WALL_M, depths[0] + hall + 2 * WALL_M)  # lower row, hall, upper row
    rooms: list[RoomPlan] = []
    for row, low, depth in ((lower, y[0], depths[0]), (upper, y[2], depths[1])):
        walls = WALL_M * (len(row) - 1)
        x = 0.0
        for kind in row:
            wide = (length - walls) * area[kind] / sum(area[one] for one in row)
            rooms.append(RoomPlan(kind, _kind(kind), (x, low), (x + wide, low + depth)))
            x += wide + WALL_M
    if at_end:
        across = y[2] + depths[1]
        x = length + WALL_M
        rooms.append(RoomPlan("living", "living", (x, 0.0), (x + area["living"] / across, across)))
    rooms.append(RoomPlan(HALL, HALL, (0.0, y[1]), (length, y[1] + hall)))
    return tuple(rooms)


def _kind(name: str) -> str:
    return name.rstrip("2")


def _awkwardness(rooms: Sequence[RoomPlan]) -> float:
    """Penalty for rooms that are not square, and a large one for rooms that are too narrow."""
    total = 0.0
    for room in rooms[:-1]:
        short, long = np.sort(room.size)
        total += max(0.0, long / short - 1.3) ** 2 * room.area
        total += 1000.0 * max(0.0, _LEAST_M.get(room.kind, 2.6) - short)
    floor = sum(room.area for room in rooms)
    low, high = AREA_M2
    return total + 1000.0 * max(0.0, low + 1.0 - floor, floor - high + 1.0)


def _turned(rng: Rng, rooms: Sequence[RoomPlan]) -> tuple[RoomPlan, ...]:
    """Randomly mirror the home in x and y, and choose the hall's direction, x or y."""
    far = np.max([room.high for room in rooms], axis=0)
    mirrored, swapped = rng.random(2) < 0.5, rng.random() < 0.5

    def turned(room: RoomPlan) -> RoomPlan:
        low, high = np.array(room.low), np.array(room.high)
        low, high = np.where(mirrored, far - high, low), np.where(mirrored, far - low, high)
        if swapped:
            low, high = low[::-1], high[::-1]
        return replace(room, low=tuple(low.tolist()), high=tuple(high.tolist()))

    return tuple(turned(room) for room in rooms)


def _with_windows(rng: Rng, rooms: Sequence[RoomPlan], index: int) -> RoomPlan:
    """Add a window to a room's longest outer wall, and to the next one if the room is large."""
    room = rooms[index]
    if room.kind == HALL:
        return room
    box = Room((*room.size, 0.0))
    walls = sorted(_outer_walls(rooms, index), key=box.length, reverse=True)
    windows = []
    for wall in walls[: 2 if room.area > 16.0 else 1]:
        length = box.length(wall)
        width = min(rng.uniform(1.2, 1.9), length - 1.2)
        sill, height = rng.uniform(0.82, 0.9), 1.3
        if room.kind == "bathroom":
            width, sill, height = min(width, 0.8), 1.35, 0.75
        elif room.kind == "kitchen":
            sill, height = 1.08, 1.1
        slack = length / 2 - width / 2 - 0.5
        along = rng.uniform(-slack, slack)
        windows.append((wall, Window(float(along), float(sill), float(width), height)))
    return replace(room, windows=tuple(windows))


def _outer_walls(rooms: Sequence[RoomPlan], index: int) -> list[int]:
    """Walls of a room with no room behind them, numbered as in ``Room``."""
    low = np.min([one.low for one in rooms], axis=0)
    high = np.max([one.high for one in rooms], axis=0)
    to_high = np.isclose(rooms[index].high, high)
    to_low = np.isclose(rooms[index].low, low)
    is_outer = (to_high[1], to_high[0], to_low[1], to_low[0])
    return [wall for wall in range(4) if is_outer[wall]]


def _doors(rng: Rng, rooms: Sequence[RoomPlan]) -> tuple[Doorway, ...]:
    """Doors from the hall to every room, an opening from kitchen to living room, the entrance."""
    hall = len(rooms) - 1
    doors = []
    for index in range(hall):
        shared = _shared_wall(rooms, index, hall)
        assert shared is not None  # rows and end room touch the hall
        doors.append(_door(rng, shared, (index, hall)))
    for a in range(hall):
        for b in range(a + 1, hall):
            kinds = {rooms[a].kind, rooms[b].kind}
            chance = ({"kitchen", "living"} == kinds and 0.8) or 0.1
            shared = _shared_wall(rooms, a, b)
            if shared is None or shared.length < 1.9 or rng.random() > chance:
                continue
            doors.append(_door(rng, shared, (a, b), is_wide=chance > 0.5))
    return (*doors, _entrance(rng, rooms, hall))


@dataclass(frozen=True)
class _SharedWall:
    """The wall shared by two rooms: the middle of the wall from ``low`` to ``high`` (2,)."""

    low: Float64
    high: Float64
    along_x: bool  # the way through it
    is_swapped: bool  # the first room is on the high side

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.high - self.low))


def _shared_wall(rooms: Sequence[RoomPlan], a: int, b: int) -> _SharedWall | None:
    one, other = rooms[a], rooms[b]
    low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
    for axis in (0, 1):
        # Across the wall, one room starts a wall's thickness after the other ends.
        if abs(low[axis] - high[axis] - WALL_M) < 1e-6 and high[1 - axis] - low[1 - axis] > 1.2:
            middle = (low[axis] + high[axis]) / 2
            low[axis] = high[axis] = middle
            return _SharedWall(low, high, axis == 0, one.low[axis] > middle)
    return None


def _door(rng: Rng, wall: _SharedWall, rooms: tuple[int, int], is_wide: bool = False) -> Doorway:
    """Add a door near an end of a shared wall, or a wide opening at its centre."""
    margin = _CASING_M + _CORNER_M
    if is_wide:
        width = min(rng.uniform(*_WIDE_M), wall.length - 2 * margin)
        share = rng.uniform(0.4, 0.6)
    else:
        width = DOOR_M
        share = float(rng.choice([rng.uniform(0.0, 0.15), rng.uniform(0.85, 1.0), rng.random()]))
    room = wall.length - width - 2 * margin
    at = margin + width / 2 + share * room
    middle = wall.low + at / wall.length * (wall.high - wall.low)
    order = (rooms[1], rooms[0]) if wall.is_swapped else rooms
    leaf = None
    if not is_wide and rng.random() < 0.85:
        leaf = float(np.radians(rng.uniform(80.0, 105.0)))
    # The leaf opens into the room, not into the hall, towards the nearer corner.
    hinge = -1 if share < 0.5 else 1
    return Doorway(
        tuple(middle.tolist()),
        wall.along_x,
        order,
        float(width),
        leaf,
        order.index(rooms[0]),
        hinge,
    )


def _entrance(rng: Rng, rooms: Sequence[RoomPlan], hall: int) -> Doorway:
    """Add a closed door at an end of the hall that is an outer wall."""
    own = rooms[hall]
    along_x = own.size[0] > own.size[1]
    ends = [wall for wall in _outer_walls(rooms, hall) if (wall % 2 == 1) == along_x]
    box = Room((*own.size, 0.0))
    middle = box.wall_frame(int(rng.choice(ends)))[0][:2] + own.low
    return Doorway(tuple(middle.tolist()), bool(along_x), (hall,), DOOR_M)
