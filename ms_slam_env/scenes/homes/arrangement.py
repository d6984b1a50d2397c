"""Furniture placement in a room: along walls, clear of doors, windows and other furniture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import ndimage

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.room import Opening, Room, Window
from ms_slam_env.scenes.scene import Rng

Box = tuple[float, float, float, float]
"""Lower x and y, upper x and y of a footprint; or ranges along and up a wall."""

APPROACH_M = 0.8
"""Depth of floor kept free on both sides of a doorway."""
_SWING_M = 0.95
_BESIDE_DOOR_M = 0.14  # casing
_BEYOND_HINGE_M = 0.3
_CURTAIN_M = 0.45
_LOW_M = 0.75  # lower furniture fits under a window
_STEP_M = 0.08  # between positions tried along a wall
_CELL_M = 0.1
_WALKER_M = 0.25  # half the width kept free between furniture
_APART_M = 0.03


@dataclass(frozen=True)
class LocalDoor:
    """A door, described from one of its rooms.

    Attributes:
        wall: wall that it is in.
        opening: its doorway in that wall.
        hinge: -1 or 1, the end along the wall where a leaf opening into this room hangs; 0: none.
    """

    wall: int
    opening: Opening
    hinge: int = 0


@dataclass(frozen=True)
class Spot:
    """A position at a wall, ``gap`` metres in front of it."""

    wall: int
    along: float
    gap: float


def overlap(a: Box, b: Box, apart: float = 0.0) -> bool:
    """Whether two boxes are nearer than ``apart``."""
    return bool(
        a[0] < b[2] + apart and b[0] < a[2] + apart and a[1] < b[3] + apart and b[1] < a[3] + apart
    )


class Arrangement:
    """Occupied parts of a room's floor and walls.

    Attributes:
        room: the room.
        doorsteps: floor kept free, in front of doors and under their leaves.
        standing: footprints of furniture.
        curtains: floor under curtains, where nothing tall may stand.
        on_walls: occupied ranges along and up each wall.
    """

    def __init__(self, room: Room, doors: Sequence[LocalDoor], windows: dict[int, Window]) -> None:
        """Start with an empty room."""
        self.room = room
        self.doorsteps: list[Box] = []
        self.standing: list[Box] = []
        self.curtains: list[Box] = []
        self.on_walls: dict[int, list[Box]] = {wall: [] for wall in range(4)}
        for door in doors:
            at, half = door.opening.along, door.opening.width / 2 + _BESIDE_DOOR_M
            self.on_walls[door.wall].append((at - half, 0.0, at + half, door.opening.height + 0.1))
            low = at - half - (_BEYOND_HINGE_M if door.hinge < 0 else 0.0)
            high = at + half + (_BEYOND_HINGE_M if door.hinge > 0 else 0.0)
            deep = _SWING_M if door.hinge else APPROACH_M
            self.doorsteps.append(self._footprint(door.wall, low, high, 0.0, deep))
        for wall, window in windows.items():
            half = window.width / 2 + _CURTAIN_M
            top = window.sill + window.height + 0.25
            box = (window.along - half, window.sill - 0.1, window.along + half, top)
            self.on_walls[wall].append(box)
            self.curtains.append(self._footprint(wall, box[0], box[2], 0.0, 0.17))

    def stand(
        self,
        rng: Rng,
        size: tuple[float, float, float],
        walls: Sequence[int] = (0, 1, 2, 3),
        gap: float = 0.02,
        before: float = 0.0,
        in_corner: bool = False,
        near: float | None = None,
        off: float = np.inf,
    ) -> Spot | None:
        """Reserve a position at a wall for an object of width, depth, height ``size``, or None.

        Args:
            rng: draws the wall and the position.
            size: metres.
            walls: walls to choose from, preferred ones first.
            gap: distance to the wall.
            before: depth of floor in front of it to keep free.
            in_corner: try the ends of the walls first.
            near: try this position along the wall first, then the nearest ones.
            off: largest distance from ``near``.
        """
        width, depth, height = size
        for wall in walls:
            for along in self._alongs(rng, wall, width, in_corner, near, off):
                on_wall = (along - width / 2, 0.0, along + width / 2, height)
                if any(overlap(on_wall, taken) for taken in self.on_walls[wall]):
                    continue
                low, high = on_wall[0], on_wall[2]
                box = self._footprint(wall, low, high, gap, gap + depth)
                if height > _LOW_M and any(overlap(box, curtain) for curtain in self.curtains):
                    continue
                reach = self._footprint(wall, low, high, gap, gap + depth + before)
                if not self._is_free(box) or any(overlap(reach, b) for b in self.standing):
                    continue
                if self._walkable_with(box):
                    self.standing.append(box)
                    self.on_walls[wall].append(on_wall)
                    return Spot(wall, along, gap)
        return None

    def hang(
        self,
        rng: Rng,
        size: tuple[float, float],
        z: float,
        walls: Sequence[int] = (0, 1, 2, 3),
        near: float | None = None,
        off: float = np.inf,
        depth: float = 0.0,
    ) -> Spot | None:
        """Reserve a position on a wall for an object of width and height ``size``, centre at ``z``.

        An object ``depth`` thick must not block a door.
        """
        width, height = size
        for wall in walls:
            for along in self._alongs(rng, wall, width, False, near, off):
                low, high = along - width / 2 - 0.04, along + width / 2 + 0.04
                box = (low, z - height / 2 - 0.03, high, z + height / 2 + 0.03)
                if depth and not self.is_clear_of_doors(wall, low, high, depth):
                    continue
                if not any(overlap(box, taken) for taken in self.on_walls[wall]):
                    self.on_walls[wall].append(box)
                    return Spot(wall, along, 0.0)
        return None

    def in_the_room(
        self,
        rng: Rng,
        size: tuple[float, float],
        low: Float64 | None = None,
        high: Float64 | None = None,
        tries: int = 60,
    ) -> Float64 | None:
        """Reserve floor of ``size`` (x, y) away from the walls; return its centre (2,) or None."""
        extent = np.array(size)
        least = extent / 2 + 0.05 if low is None else low
        most = np.array(self.room.size[:2]) - extent / 2 - 0.05 if high is None else high
        if (most <= least).any():
            return None
        for _ in range(tries):
            middle = rng.uniform(least, most)
            if self.take(middle, size):
                return middle
        return None

    def take(self, middle: Float64, size: tuple[float, float]) -> bool:
        """Reserve the floor of ``size`` around ``middle`` (2,) if it is free."""
        low, high = np.subtract(middle, np.divide(size, 2)), np.add(middle, np.divide(size, 2))
        box = (*low.tolist(), *high.tolist())
        inside = (low > 0).all() and (high < self.room.size[:2]).all()
        if not (inside and self._is_free(box) and self._walkable_with(box)):
            return False
        self.standing.append(box)
        return True

    def is_floor_free(self, wall: int, low: float, high: float, depth: float) -> bool:
        """Whether nothing stands in front of a section of a wall and no door opens there."""
        return self._is_free(self._footprint(wall, low, high, 0.0, depth))

    def is_clear_of_doors(self, wall: int, low: float, high: float, depth: float) -> bool:
        """Whether a section of a wall is clear of doors and of the way through them."""
        box = self._footprint(wall, low, high, 0.0, depth)
        return not any(overlap(box, doorstep) for doorstep in self.doorsteps)

    def _alongs(
        self, rng: Rng, wall: int, width: float, in_corner: bool, near: float | None, off: float
    ) -> Iterator[float]:
        """Positions along a wall for an object of ``width``, better ones first."""
        slack = self.room.length(wall) / 2 - width / 2 - 0.02
        if slack < 0:
            return
        places = np.linspace(-slack, slack, max(2, int(2 * slack / _STEP_M) + 1))
        places = rng.permutation(places)
        if in_corner:
            places = places[np.argsort(-np.abs(places), kind="stable")]
        elif near is not None:
            places = places[np.argsort(np.abs(places - near), kind="stable")]
            places = places[np.abs(places - near) <= off]
        yield from places.tolist()

    def _footprint(self, wall: int, low: float, high: float, near: float, far: float) -> Box:
        """Floor box between two positions along a wall and two distances from it."""
        corners = [
            self.room.to_world(wall, (a, -d, 0))[:2] for a, d in product((low, high), (near, far))
        ]
        return (*np.min(corners, axis=0).tolist(), *np.max(corners, axis=0).tolist())

    def _is_free(self, box: Box) -> bool:
        return not any(overlap(box, other) for other in self.doorsteps) and not any(
            overlap(box, other, _APART_M) for other in self.standing
        )

    def _walkable_with(self, box: Box) -> bool:
        """Whether each door, and most of the free floor, can still be reached from all doors."""
        w, d, _ = self.room.size
        x, y = (
            np.arange(_WALKER_M, w - _WALKER_M, _CELL_M),
            np.arange(_WALKER_M, d - _WALKER_M, _CELL_M),
        )
        free = np.ones((len(x), len(y)), bool)
        for a, b, c, e in (*self.standing, box):
            inside_x = (x > a - _WALKER_M) & (x < c + _WALKER_M)
            inside_y = (y > b - _WALKER_M) & (y < e + _WALKER_M)
            free &= ~(inside_x[:, None] & inside_y[None, :])
        component, count = ndimage.label(free)
        if count == 0:
            return False
        sizes = np.bincount(component.ravel())[1:]
        largest = 1 + int(np.argmax(sizes))
        for a, b, c, e in self.doorsteps:
            i = np.argmin(np.abs(x - (a + c) / 2))
            j = np.argmin(np.abs(y - (b + e) / 2))
            if component[i, j] != largest:
                return False
        return bool(sizes.max() >= 0.8 * sizes.sum())


@dataclass
class Furnisher:
    """Furnishes one room, in the room's coordinates.

    Attributes:
        build: receives the furniture.
        rng: draws all choices.
        name: name of the room.
        kind: kind of the room.
        windows: windows by wall.
        arrangement: occupied floor and walls.
        bulbs: positions (3,) of lit bulbs.
        doors: doors of the room.
        has_kitchen: whether it includes a kitchen, because the home has no other.
    """

    build: MeshBuilder
    rng: Rng
    name: str
    kind: str
    windows: dict[int, Window]
    doors: Sequence[LocalDoor]
    arrangement: Arrangement
    bulbs: list[Float64]
    has_kitchen: bool = False

    @property
    def room(self) -> Room:
        """The room."""
        return self.arrangement.room

    def walls(self) -> list[int]:
        """The walls in random order."""
        return self.rng.permutation(4).tolist()

    @contextmanager
    def at(self, spot: Spot, z: float = 0.0) -> Iterator[None]:
        """Add objects in the frame of a spot at a wall."""
        with self.room.at_wall(self.build, spot.wall, spot.along, z, spot.gap):
            yield
