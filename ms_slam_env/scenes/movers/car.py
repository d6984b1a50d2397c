"""A passenger car."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.movers.shape import Joint, Piece, Shape, assemble
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures.noise import grain, hsv

_LENGTH_M = (3.9, 4.6)
_WHEEL_M = 0.31  # radius


def car(rng: Rng, length_m: float | None = None) -> Shape:
    """Painted body, windows, lights, plates and rolling wheels; the origin is on the ground.

    Args:
        rng: draws paint, proportions and omitted values.
        length_m: overall length.
    """
    length = float(length_m if length_m is not None else rng.uniform(*_LENGTH_M))
    width, height = rng.uniform(1.68, 1.82), rng.uniform(1.42, 1.55)
    half, axle = 0.5 * length, 0.295 * length
    paint = grain(rng, _paint(rng), (128, 128), (0.02, 1.2))
    pieces: list[Piece] = [(_body(rng, half, 0.5 * width, height, paint, axle), Joint())]
    for x in (axle, -axle):
        for side in (-1, 1):
            hub = (x, side * (0.5 * width - 0.07), _WHEEL_M)
            roll = Joint(hub, (0.0, 1.0, 0.0), roll_rad_m=1 / _WHEEL_M)
            pieces.append((_wheel(hub, side), roll))
    radius = float(np.hypot(half, 0.5 * width))
    return Shape("car", assemble(pieces, cell_m=0.25), radius, length, width, height)


def _paint(rng: Rng) -> np.ndarray:
    if rng.random() < 0.4:
        return np.full(3, rng.choice([60.0, 130.0, 185.0, 225.0]))
    return hsv(
        rng.choice([0.0, 0.02, 0.14, 0.33, 0.56, 0.62]),
        rng.uniform(0.5, 0.9),
        rng.uniform(0.4, 0.8),
    )


def _body(
    rng: Rng, half: float, side: float, height: float, colours: np.ndarray, axle: float
) -> Callable[[MeshBuilder], None]:
    """Hull, cabin and trim."""
    belt = rng.uniform(0.84, 0.92)
    # Outline of the hull from the rear to the front: x, its lower and upper edge, half width.
    hull = np.array(
        [
            (-half, 0.45, belt - 0.16, 0.86 * side),
            (-half + 0.06, 0.27, belt - 0.05, 0.95 * side),
            (-0.62 * half, 0.2, belt, side),
            (0.1 * half, 0.2, belt, side),
            (0.42 * half, 0.2, belt - 0.02, side),
            (0.8 * half, 0.22, belt - 0.13, 0.97 * side),
            (half - 0.05, 0.27, belt - 0.24, 0.9 * side),
            (half, 0.4, belt - 0.34, 0.8 * side),
        ]
    )
    # Corners of the cabin at the belt and at the roof: x of rear and front, half width.
    foot, roof = (-0.86 * half, 0.46 * half, 0.93 * side), (-0.6 * half, 0.1 * half, 0.72 * side)

    def add(build: MeshBuilder) -> None:
        paint = build.material(colours, (1.0, 1.0))
        glass = build.material(_glass(rng), None)
        dark = build.plain((28, 28, 30))
        build.patch(_hull_rings(hull), paint)
        for ring, sign in ((0, -1), (-1, 1)):
            _cap(build, hull[ring], sign, paint)
        _cabin(build, foot, roof, belt - 0.03, height, paint, glass)
        for x in (axle, -axle):  # wheel arches
            for sign in (-1, 1):
                y = sign * (side - 0.02)
                _disc(build, (x, y + sign * 0.03, _WHEEL_M + 0.02), 1.2 * _WHEEL_M, sign, dark)
        for y in (-0.62 * side, 0.62 * side):
            w = 0.2 * side
            lamp, tail = build.plain((250, 248, 235)), build.plain((190, 25, 22))
            z = belt - 0.34
            build.pillow((half - 0.1, y - w, z - 0.07), (half + 0.01, y + w, z + 0.05), lamp, 0.5)
            z = belt - 0.2
            build.pillow((-half - 0.02, y - w, z - 0.08), (-half + 0.1, y + w, z + 0.08), tail, 0.4)
        for x in (half - 0.02, -half - 0.02):  # plates; the grille above the front one
            plate = build.plain((235, 235, 225))
            build.box((x, -0.26, 0.42), (x + 0.04, 0.26, 0.53), plate)
        build.box((half - 0.04, -0.4 * side, 0.56), (half + 0.015, 0.4 * side, 0.6), dark)
        for sign in (-1, 1):  # bumpers below, door handles and lines
            build.box(
                (-half + 0.1, sign * side - 0.02, 0.2), (half - 0.3, sign * side + 0.01, 0.27), dark
            )
            for x in (-0.28 * half, 0.14 * half):
                y = sign * (side + 0.005)
                build.box((x, y - 0.012, belt - 0.16), (x + 0.16, y + 0.012, belt - 0.13), dark)
            for x in (-0.36 * half, 0.02 * half, 0.4 * half):
                y = sign * side
                build.box((x, y - 0.004, 0.28), (x + 0.012, y + 0.004, belt - 0.04), dark)

    return add


def _hull_rings(hull: np.ndarray, sides: int = 20) -> np.ndarray:
    """Grid (n, sides + 1, 3): rounded rectangles across the direction of travel."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.35
    rise = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.35
    x, low, high, half = (hull[:, k, None] for k in range(4))
    y = half * ring
    z = 0.5 * (low + high) + 0.5 * (high - low) * rise
    return np.stack([np.broadcast_to(x, y.shape), y, z], -1)


def _cap(build: MeshBuilder, outline: np.ndarray, sign: int, paint: Material) -> None:
    """Close the hull at one end."""
    rim = _hull_rings(outline[None])[0]
    middle = np.broadcast_to(rim.mean(0), rim.shape)
    build.patch(np.stack([rim, middle] if sign > 0 else [middle, rim]), paint)


def _cabin(
    build: MeshBuilder,
    foot: tuple[float, float, float],
    roof: tuple[float, float, float],
    low: float,
    high: float,
    paint: Material,
    glass: Material,
) -> None:
    """A truncated pyramid: painted, with a pane on each side and a pillar in the middle."""

    def corners(level: tuple[float, float, float], z: float) -> np.ndarray:
        rear, front, w = level
        return np.array([(rear, -w, z), (front, -w, z), (front, w, z), (rear, w, z)])

    below, above = corners(foot, low), corners(roof, high)
    build.patch([[above[0], above[1]], [above[3], above[2]]], paint)
    for k in range(4):
        a, b, c, d = below[k], below[(k + 1) % 4], above[(k + 1) % 4], above[k]
        build.patch([[a, b], [d, c]], paint)
        out = np.cross(b - a, d - a)
        out *= 0.006 / np.linalg.norm(out)
        panes = ((0.06, 0.48), (0.53, 0.94)) if k % 2 == 0 else ((0.05, 0.95),)
        for left, right in panes:
            pane = [
                [(1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c) for u in (left, right)]
                for v in (0.14, 0.9)
            ]
            build.patch(np.array(pane) + out, glass)


def _glass(rng: Rng, size: int = 64) -> np.ndarray:
    """A dark pane: paler above, where it mirrors the sky."""
    ramp = np.linspace(95, 25, size)[:, None, None] * np.array([0.85, 0.95, 1.0])
    return grain(rng, np.broadcast_to(ramp, (size, size, 3)), (size, size), (0.1, 1.5))


def _wheel(hub: tuple[float, float, float], side: int) -> Callable[[MeshBuilder], None]:
    """Tyre and a rim with five spokes, the outside at ``side``."""

    def add(build: MeshBuilder) -> None:
        tyre = build.plain((26, 26, 27))
        rim = build.material(_rim(), None)
        x, y, z = hub
        inner, outer = y - 0.1, y + 0.1
        angle = np.linspace(0, 2 * np.pi, 25)
        circle = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], -1)
        centre = np.array([x, 0.0, z])
        profile = ((0.8, inner), (1.0, inner + 0.03), (1.0, outer - 0.03), (0.8, outer))
        rings = [centre + _WHEEL_M * r * circle + [0.0, at, 0.0] for r, at in profile]
        build.patch(np.stack(rings[::-1]), tyre, inset=False)
        for sign in (-1, 1):
            at = (x, (outer if sign > 0 else inner) - sign * 0.005, z)
            _disc(build, at, 0.82 * _WHEEL_M, sign, rim if sign == side else tyre)

    return add


def _disc(
    build: MeshBuilder, centre: tuple[float, float, float], radius: float, sign: int, skin: Material
) -> None:
    """A flat disc facing +y or -y, its image stretched over it."""
    angle = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], -1)
    grid = np.stack([0.02 * circle, circle]) * radius + np.asarray(centre)
    uv = 0.5 + 0.49 * np.stack([0.02 * circle[:, [0, 2]], circle[:, [0, 2]]])
    if sign < 0:
        grid, uv = grid[::-1], uv[::-1]
    build.patch(grid, skin, uv, inset=False)


def _rim(size: int = 128) -> np.ndarray:
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    is_bright = (np.cos(5 * angle) > 0.3 - 0.3 * r) | (r > 0.88) | (r < 0.22)
    return np.where(is_bright[..., None], 190, 35).astype(np.uint8).repeat(3, axis=2)
