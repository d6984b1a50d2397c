"""Where furniture can stand in a room: along walls, clear of doors, windows and other things."""

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
"""Least x and y, greatest x and y of a footprint; or from where to where along and up a wall."""

APPROACH_M = 0.8
"""Floor before a doorway that stays free, on both sides."""
_SWING_M = 0.95
_BESIDE_DOOR_M = 0.14  # casing
_BEYOND_HINGE_M = 0.3
_CURTAIN_M = 0.45
_LOW_M = 0.75  # what is lower fits under a window
_STEP_M = 0.08  # between places tried along a wall
_CELL_M = 0.1
_WALKER_M = 0.25  # half the width that stays free between furniture
_APART_M = 0.03


@dataclass(frozen=True)
class LocalDoor:
    """A door as one of its rooms sees it.

    Attributes:
        wall: in which it is.
        opening: where.
        hinge: -1 or 1, the end along the wall where a leaf hangs opening into this room; 0: none.
    """

    wall: int
    opening: Opening
    hinge: int = 0


@dataclass(frozen=True)
class Spot:
    """A place at a wall, ``gap`` metres before it."""

    wall: int
    along: float
    gap: float


def overlap(a: Box, b: Box, apart: float = 0.0) -> bool:
    """Whether two boxes are nearer than ``apart``."""
    return bool(
        a[0] < b[2] + apart and b[0] < a[2] + apart and a[1] < b[3] + apart and b[1] < a[3] + apart
    )


class Arrangement:
    """What is taken of the floor and of the walls of a room.

    Attributes:
        room: the room.
        doorsteps: floor that must stay free, before doors and under their leaves.
        standing: footprints of furniture.
        curtains: floor under curtains, where nothing tall may stand.
        on_walls: by wall, what is taken of it: from where to where, from which height to which.
    """

    def __init__(self, room: Room, doors: Sequence[LocalDoor], windows: dict[int, Window]) -> None:
        """An empty room."""
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
        """Take a place at a wall for something of width, depth and height ``size``; None: no room.

        Args:
            rng: draws the wall and the place.
            size: metres.
            walls: to choose from, the preferred first.
            gap: to the wall.
            before: floor that no other piece may take, in front of it.
            in_corner: try the ends of the walls first.
            near: try this place along the wall first, and the next ones after it.
            off: how far from it at most.
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
        """Take a place on a wall for something of width and height ``size``, middle at ``z``.

        What is ``depth`` thick hangs in the way of no door.
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
        """Take floor of ``size`` (x, y) away from the walls; its middle (2,), None: no room."""
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
        """Take the floor of ``size`` around ``middle`` (2,) if it is free."""
        low, high = np.subtract(middle, np.divide(size, 2)), np.add(middle, np.divide(size, 2))
        box = (*low.tolist(), *high.tolist())
        inside = (low > 0).all() and (high < self.room.size[:2]).all()
        if not (inside and self._is_free(box) and self._walkable_with(box)):
            return False
        self.standing.append(box)
        return True

    def is_floor_free(self, wall: int, low: float, high: float, depth: float) -> bool:
        """Whether nothing stands before a stretch of a wall and no door opens there."""
        return self._is_free(self._footprint(wall, low, high, 0.0, depth))

    def is_clear_of_doors(self, wall: int, low: float, high: float, depth: float) -> bool:
        """Whether no door opens, and none is gone through, before a stretch of a wall."""
        box = self._footprint(wall, low, high, 0.0, depth)
        return not any(overlap(box, doorstep) for doorstep in self.doorsteps)

    def _alongs(
        self, rng: Rng, wall: int, width: float, in_corner: bool, near: float | None, off: float
    ) -> Iterator[float]:
        """Places along a wall for something so wide, the better ones first."""
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
        """Box on the floor that lies between two places along a wall, between two distances."""
        corners = [
            self.room.to_world(wall, (a, -d, 0))[:2] for a, d in product((low, high), (near, far))
        ]
        return (*np.min(corners, axis=0).tolist(), *np.max(corners, axis=0).tolist())

    def _is_free(self, box: Box) -> bool:
        return not any(overlap(box, other) for other in self.doorsteps) and not any(
            overlap(box, other, _APART_M) for other in self.standing
        )

    def _walkable_with(self, box: Box) -> bool:
        """Whether one still gets from each door to all others, and to most of the free floor."""
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
    """Puts things into one room; every coordinate is the room's own.

    Attributes:
        build: takes the things.
        rng: draws all choices.
        name: of the room.
        kind: of the room.
        windows: by wall.
        arrangement: of the room.
        bulbs: places (3,) of bulbs that shine.
        doors: of the room.
        has_kitchen: whether a kitchen is part of it, the dwelling having no other.
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
        """Its size."""
        return self.arrangement.room

    def walls(self) -> list[int]:
        """The walls in random order."""
        return self.rng.permutation(4).tolist()

    @contextmanager
    def at(self, spot: Spot, z: float = 0.0) -> Iterator[None]:
        """Add things in the frame of a spot at a wall."""
        with self.room.at_wall(self.build, spot.wall, spot.along, z, spot.gap):
            yield
