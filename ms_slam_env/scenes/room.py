"""Box-shaped rooms: floor, ceiling, walls, windows, skirting boards, and their finishes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior
from ms_slam_env.scenes.textures.noise import hsv

PANE = "window pane"
_REVEAL_M = 0.18


@dataclass(frozen=True)
class Window:
    """A window in a wall.

    Attributes:
        along: position of its centre, metres from the wall's centre, to the right seen from inside.
        sill: height of its lower edge, metres.
        width: metres.
        height: metres.
    """

    along: float
    sill: float
    width: float
    height: float


@dataclass(frozen=True)
class Opening:
    """A doorway in a wall, from the floor up.

    Attributes:
        along: position of its centre along the wall, as for a window.
        width: metres.
        height: metres.
    """

    along: float
    width: float
    height: float


@dataclass(frozen=True)
class Room:
    """A box-shaped room with a corner at the origin.

    Wall 0 lies at y = depth, wall 1 at x = width, wall 2 at y = 0, wall 3 at x = 0.

    Attributes:
        size: width (x), depth (y) and height (z), metres.
    """

    size: tuple[float, float, float]

    def length(self, wall: int) -> float:
        """Length of a wall, metres."""
        return self.size[wall % 2]

    def at_wall(
        self, build: MeshBuilder, wall: int, along: float = 0.0, z: float = 0.0, gap: float = 0.0
    ) -> AbstractContextManager[None]:
        """Frame on a wall: x along it to the right seen from inside, the room at -y."""
        origin, yaw = self.wall_frame(wall)
        c, s = np.cos(yaw), np.sin(yaw)
        return build.frame(origin + np.array([along * c + gap * s, along * s - gap * c, z]), yaw)

    def wall_frame(self, wall: int) -> tuple[Float64, float]:
        """Centre (3,) of a wall's lower edge, and its frame's rotation about z."""
        w, d, _ = self.size
        origin = [(w / 2, d, 0), (w, d / 2, 0), (w / 2, 0, 0), (0, d / 2, 0)][wall]
        return np.array(origin, dtype=np.float64), (0.0, -np.pi / 2, np.pi, np.pi / 2)[wall]

    def to_world(self, wall: int, point: tuple[float, float, float]) -> Float64:
        """World coordinates (3,) of a point given in a wall's frame."""
        origin, yaw = self.wall_frame(wall)
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, z = point
        return origin + np.array([x * c - y * s, x * s + y * c, z])

    def shell(
        self,
        build: MeshBuilder,
        floor: Material,
        walls: tuple[Material, Material, Material, Material],
        ceiling: Material,
        windows: dict[int, Window] | None = None,
        skirting: Material | None = None,
        doorways: Mapping[int, Sequence[Opening]] | None = None,
    ) -> None:
        """Add floor, ceiling, walls ("wall 0" to "wall 3"), windows and skirting boards.

        Windows and doorways in a wall must not overlap; doors are not added.
        """
        w, d, h = self.size
        with build.object("floor"):
            build.quad((0, 0, 0), (w, 0, 0), (0, d, 0), floor)
        with build.object("ceiling"):
            build.quad((0, d, h), (w, 0, 0), (0, -d, 0), ceiling)
        for wall in range(4):
            window = (windows or {}).get(wall)
            passages = (doorways or {}).get(wall, ())
            with self.at_wall(build, wall):
                with build.object(f"wall {wall}"):
                    self._wall(build, self.length(wall), walls[wall], window, passages)
                if window is not None:
                    add_window(build, window)
                if skirting is not None:
                    with build.object(f"skirting {wall}"):
                        for a, b in _between(self.length(wall), [_hole(one) for one in passages]):
                            build.box((a, -0.015, 0), (b, 0, 0.08), skirting, "xXYz")

    def _wall(
        self,
        build: MeshBuilder,
        length: float,
        material: Material,
        window: Window | None,
        doorways: Sequence[Opening],
    ) -> None:
        h = self.size[2]
        holes = [_hole(one) for one in ((window,) if window else ()) + tuple(doorways)]
        pieces = [(a, b, 0.0, h) for a, b in _between(length, holes)]
        for a, b, low, high in holes:
            pieces += [(a, b, 0.0, low)] if low > 0 else []
            pieces += [(a, b, high, h)]
        for a, b, low, high in pieces:
            build.quad((a, 0, low), (b - a, 0, 0), (0, 0, high - low), material, (a, low))


def _hole(opening: Window | Opening) -> tuple[float, float, float, float]:
    """Range along the wall, and range of heights."""
    low = opening.sill if isinstance(opening, Window) else 0.0
    half = opening.width / 2
    return opening.along - half, opening.along + half, low, low + opening.height


def _between(
    length: float, holes: Sequence[tuple[float, float, float, float]]
) -> list[tuple[float, float]]:
    """Ranges of a wall without a hole."""
    ends = [-length / 2, *(end for hole in sorted(holes) for end in hole[:2]), length / 2]
    return list(zip(ends[::2], ends[1::2], strict=True))


def add_window(build: MeshBuilder, window: Window) -> None:
    """Add reveal, sill, frame with a cross bar, and the bright pane, in a wall's frame."""
    paint = build.plain((238, 236, 230))
    a, b = window.along - window.width / 2, window.along + window.width / 2
    low, high, deep = window.sill, window.sill + window.height, _REVEAL_M
    with build.object("window frame"):
        build.quad((a, 0, low), (0, deep, 0), (0, 0, high - low), paint)
        build.quad((b, deep, low), (0, -deep, 0), (0, 0, high - low), paint)
        build.quad((a, deep, high), (b - a, 0, 0), (0, -deep, 0), paint)
        build.quad((a, 0, low), (b - a, 0, 0), (0, deep, 0), paint)
        f, y = 0.06, deep - 0.05
        middle = (a + b) / 2
        for x in (a, middle - f / 2, b - f):
            build.box((x, y, low), (x + f, deep, high), paint, "YzZ")
        third = low + 0.68 * (high - low)
        for z in (low, third, high - f):
            build.box((a, y, z), (b, deep, z + f), paint, "YxX")
    with build.object("window sill"):
        build.box((a - 0.04, -0.12, low - 0.03), (b + 0.04, 0.0, low), paint, "Y")
    with build.object(PANE):
        build.quad(
            (a, deep - 0.02, low), (b - a, 0, 0), (0, 0, high - low), build.plain((255,) * 3)
        )


def floor_material(build: MeshBuilder, rng: Rng) -> Material:
    """Wooden planks; the texture covers 2 x 1.2 m."""
    tone = interior.TONES[rng.integers(len(interior.TONES))]
    return build.material(interior.planks(rng, tone), (2.0, 1.2))


def wall_colour(rng: Rng) -> Float64:
    """Draw a muted light paint colour."""
    return hsv(
        rng.choice([0.09, 0.12, 0.16, 0.3, 0.55, 0.6]),
        rng.uniform(0.04, 0.22),
        rng.uniform(0.74, 0.92),
    )


def wall_material(build: MeshBuilder, rng: Rng, colour: Float64, papered: bool) -> Material:
    """Make plaster in ``colour``, or wallpaper or brick if ``papered``."""
    if not papered:
        return build.material(interior.plaster(rng, colour), (2.0, 2.0))
    if rng.random() < 0.25:
        return build.material(interior.brick(rng, hsv(0.03, 0.5, 0.62)), (0.75, 0.6))
    accent = np.clip(colour * rng.uniform(0.6, 0.85, 3), 0, 255)
    return build.material(interior.wallpaper(rng, colour, accent), (0.9, 0.9))
