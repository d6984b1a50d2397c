"""Street grids: layout of carriageways, pavements and plots."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder

KERB_M = 0.12


@dataclass(frozen=True)
class Plot:
    """Ground beside a street.

    Attributes:
        origin: (3,) left end, seen from the street, of its edge along the pavement; metres.
        yaw: rotation of its frame about z: x along the street, y away from it.
        width_m: along the street.
        depth_m: away from the street.
    """

    origin: tuple[float, float, float]
    yaw: float
    width_m: float
    depth_m: float


def sides_of(
    width: float, depth: float
) -> tuple[tuple[tuple[float, float, float], float, float], ...]:
    """Origin, yaw and length of each side of a rectangle, left to right seen from outside."""
    return (
        ((0, 0, 0), 0.0, width),
        ((width, 0, 0), np.pi / 2, depth),
        ((width, depth, 0), np.pi, width),
        ((0, depth, 0), -np.pi / 2, depth),
    )


@dataclass(frozen=True)
class StreetPlan:
    """Streets along x and y that cross at right angles.

    Attributes:
        xs: x of the centre lines of the streets along y, increasing, metres.
        ys: y of the centre lines of the streets along x.
        road_m: width of the carriageway.
        pavement_m: width of each pavement.
        margin_m: depth of the plots around the outermost streets.
    """

    xs: tuple[float, ...]
    ys: tuple[float, ...]
    road_m: float
    pavement_m: float
    margin_m: float

    @property
    def half_m(self) -> float:
        """Distance from a centre line to the plots."""
        return 0.5 * self.road_m + self.pavement_m

    def crossing(self, column: int, row: int) -> Float64:
        """Point (3,) where street ``column`` of ``xs`` crosses street ``row`` of ``ys``."""
        return np.array([self.xs[column], self.ys[row], 0.0])

    def crossings(self, names: tuple[tuple[str, ...], ...]) -> dict[str, Float64]:
        """Crossings (3,) by name; names are given in rows along x."""
        return {
            name: self.crossing(column, row)
            for row, those in enumerate(names)
            for column, name in enumerate(those)
        }

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Minimum x, minimum y, maximum x, maximum y of the ground."""
        out = self.half_m + self.margin_m
        return self.xs[0] - out, self.ys[0] - out, self.xs[-1] + out, self.ys[-1] + out

    def ground(
        self, build: MeshBuilder, road: Material, pavement: Material, kerb: Material, plot: Material
    ) -> None:
        """Add carriageways, pavements with kerbs, and the ground of all plots."""
        kinds = {0: road, 1: pavement, 2: plot}
        names = ("road", "pavement", "ground")
        x_edges, y_edges = self._edges(0), self._edges(1)
        cells = {
            (i, j): self._kind(0.5 * (x0 + x1), 0.5 * (y0 + y1))
            for i, (x0, x1) in enumerate(pairwise(x_edges))
            for j, (y0, y1) in enumerate(pairwise(y_edges))
        }
        for (i, j), kind in cells.items():
            x0, x1, y0, y1 = x_edges[i], x_edges[i + 1], y_edges[j], y_edges[j + 1]
            z = 0.0 if kind == 0 else KERB_M
            with build.object(names[kind]):
                build.quad((x0, y0, z), (x1 - x0, 0, 0), (0, y1 - y0, 0), kinds[kind], (x0, y0))
            if kind != 0:
                continue
            up = (0.0, 0.0, KERB_M)
            with build.object("kerb"):  # faces the carriageway
                if cells.get((i - 1, j), 0) != 0:
                    build.quad((x0, y0, 0), (0, y1 - y0, 0), up, kerb)
                if cells.get((i + 1, j), 0) != 0:
                    build.quad((x1, y1, 0), (0, y0 - y1, 0), up, kerb)
                if cells.get((i, j - 1), 0) != 0:
                    build.quad((x1, y0, 0), (x0 - x1, 0, 0), up, kerb)
                if cells.get((i, j + 1), 0) != 0:
                    build.quad((x0, y1, 0), (x1 - x0, 0, 0), up, kerb)

    def blocks(self) -> Iterator[Plot]:
        """Plots between the streets, facing the street at their minimum y."""
        for x0, x1 in pairwise(self.xs):
            for y0, y1 in pairwise(self.ys):
                h = self.half_m
                yield Plot((x0 + h, y0 + h, KERB_M), 0.0, x1 - x0 - 2 * h, y1 - y0 - 2 * h)

    def surroundings(self) -> Iterator[Plot]:
        """The four strips around the outermost streets, facing inwards; corners belong to y."""
        x0, y0, x1, y1 = self.bounds
        m = self.margin_m
        yield Plot((x0, y1 - m, KERB_M), 0.0, x1 - x0, m)
        yield Plot((x1, y0 + m, KERB_M), np.pi, x1 - x0, m)
        yield Plot((x0 + m, y0 + m, KERB_M), np.pi / 2, y1 - y0 - 2 * m, m)
        yield Plot((x1 - m, y1 - m, KERB_M), -np.pi / 2, y1 - y0 - 2 * m, m)

    def lanes(self) -> tuple[tuple[Float64, Float64], ...]:
        """Car lanes on the sides of the streets without parked cars (see ``kerbsides``)."""
        aside = 0.27 * self.road_m
        (x0, x1), (y0, y1) = (self.xs[0], self.xs[-1]), (self.ys[0], self.ys[-1])
        along_x = [
            (np.array([x0, y - aside, 0.0]), np.array([x1, y - aside, 0.0])) for y in self.ys
        ]
        along_y = [
            (np.array([x + aside, y0, 0.0]), np.array([x + aside, y1, 0.0])) for x in self.xs
        ]
        return (*along_x, *along_y)

    def kerbsides(self) -> Iterator[tuple[Float64, float, float]]:
        """Edges of the blocks: centre (3,), yaw (x along, y away from the street) and length.

        Four per block. No two blocks' first two edges face the same stretch of street, so cars
        parked along these leave room on the other side.
        """
        for plot in self.blocks():
            half_size = np.array([plot.width_m / 2, plot.depth_m / 2, 0.0])
            c = np.array(plot.origin) + half_size
            for k in range(4):
                half, length = plot.depth_m / 2, plot.width_m
                if k % 2:
                    half, length = plot.width_m / 2, plot.depth_m
                yaw = k * np.pi / 2
                yield c + half * np.array([np.sin(yaw), -np.cos(yaw), 0.0]), yaw, length

    def _kind(self, x: float, y: float) -> int:
        """0 carriageway, 1 pavement, 2 plot."""
        h = self.half_m
        if not (self.xs[0] - h < x < self.xs[-1] + h and self.ys[0] - h < y < self.ys[-1] + h):
            return 2
        dx = min(abs(x - line) for line in self.xs)
        dy = min(abs(y - line) for line in self.ys)
        r = 0.5 * self.road_m
        inside_x = self.xs[0] - r < x < self.xs[-1] + r
        inside_y = self.ys[0] - r < y < self.ys[-1] + r
        if (dx < r and inside_y) or (dy < r and inside_x):
            return 0
        return 1 if dx < h or dy < h else 2

    def _edges(self, axis: int) -> list[float]:
        lines = (self.xs, self.ys)[axis]
        low, high = self.bounds[axis], self.bounds[axis + 2]
        r, h = 0.5 * self.road_m, self.half_m
        inner = [line + offset for line in lines for offset in (-h, -r, r, h)]
        return [low, *inner, high]
