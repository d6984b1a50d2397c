"""A walking person."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.movers.shape import Joint, Piece, Shape, assemble
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric
from ms_slam_env.scenes.textures.noise import grain, hsv

_STATURE_M = (1.6, 1.85)
_LEG_SWING_RAD = 0.42
_ARM_SWING_RAD = 0.38


def person(rng: Rng, stature_m: float | None = None) -> Shape:
    """Body, head, swinging arms and legs; the origin is between the feet.

    Proportions: Drillis and Contini, "Body Segment Parameters", New York University 1966 (hip at
    0.53, shoulder at 0.82, chin at 0.87 of the stature).

    Args:
        rng: draws clothes, hair, skin and omitted values.
        stature_m: height.
    """
    h = float(stature_m if stature_m is not None else rng.uniform(*_STATURE_M))
    hip, shoulder = 0.53 * h, 0.815 * h
    stride = 0.82 * h  # two steps
    trousers, sleeve = _cloth(rng, patterned=False), _cloth(rng, patterned=False)
    skin = _skin(rng)
    pieces: list[Piece] = [(_Trunk(rng, h, trousers, skin), Joint())]
    for side, phase in ((1, 0.0), (-1, np.pi)):
        leg = Joint((0, 0, hip), (0, 1, 0), _LEG_SWING_RAD, stride, phase)
        arm = Joint((0, 0, shoulder), (0, 1, 0), _ARM_SWING_RAD, stride, phase + np.pi)
        pieces.append((_leg(h, side, trousers), leg))
        pieces.append((_arm(h, side, sleeve, skin), arm))
    return Shape("person", assemble(pieces, cell_m=0.3), 0.165 * h, 0.46 * h, 0.3 * h, h)


class _Trunk:
    """Shirt, pelvis, neck, head, hair and face."""

    def __init__(self, rng: Rng, h: float, trousers: np.ndarray, skin: np.ndarray) -> None:
        self.h = h
        self.shirt = _cloth(rng, patterned=True)
        self.trousers = trousers
        self.skin = skin
        self.hair = grain(
            rng,
            hsv(rng.uniform(0.04, 0.1), rng.uniform(0.3, 0.7), rng.uniform(0.08, 0.55)),
            (64, 64),
            (0.25, 0.5),
        )

    def __call__(self, build: MeshBuilder) -> None:
        """Add the patches."""
        h = self.h
        shirt = build.material(self.shirt, (0.5, 0.5))
        trousers = build.material(self.trousers, (0.3, 0.3))
        skin = build.material(self.skin, (0.3, 0.3))
        hair = build.material(self.hair, (0.1, 0.1))
        build.pillow((-0.065 * h, -0.098 * h, 0.47 * h), (0.065 * h, 0.098 * h, 0.6 * h), trousers)
        outline = [(0.052, 0.086, 0.55), (0.056, 0.088, 0.62), (0.062, 0.1, 0.72)]
        outline += [(0.06, 0.112, 0.79), (0.045, 0.1, 0.825), (0.024, 0.035, 0.845)]
        build.patch(_rings(np.array(outline) * h), shirt)
        neck = [(0.03, 0.03, 0.83), (0.028, 0.028, 0.89)]
        build.patch(_rings(np.array(neck) * h), skin)
        build.pillow((-0.05 * h, -0.043 * h, 0.868 * h), (0.056 * h, 0.043 * h, h), skin, 0.9)
        build.pillow(
            (-0.06 * h, -0.049 * h, 0.905 * h), (0.034 * h, 0.049 * h, 1.006 * h), hair, 0.9
        )
        dark, red = build.plain((35, 28, 26)), build.plain((150, 80, 75))
        build.pillow((0.05 * h, -0.007 * h, 0.915 * h), (0.066 * h, 0.007 * h, 0.94 * h), skin, 1.0)
        for side in (-1, 1):
            y = side * 0.018 * h
            low, high = (0.047 * h, y - 0.007 * h), (0.054 * h, y + 0.007 * h)
            build.pillow((*low, 0.938 * h), (*high, 0.946 * h), dark, 1.0)
            build.pillow((*low, 0.952 * h), (*high, 0.957 * h), hair, 1.0)
        build.pillow((0.046 * h, -0.013 * h, 0.893 * h), (0.053 * h, 0.013 * h, 0.9 * h), red, 1.0)


def _leg(h: float, side: int, cloth: np.ndarray) -> Callable[[MeshBuilder], None]:
    def add(build: MeshBuilder) -> None:
        trousers = build.material(cloth, (0.3, 0.3))
        shoe = build.plain((45, 38, 34))
        outline = [(0.035, 0.033, 0.035), (0.036, 0.034, 0.12), (0.04, 0.037, 0.28)]
        outline += [(0.052, 0.047, 0.45), (0.054, 0.05, 0.535)]
        rings = _rings(np.array(outline) * h)
        build.patch(rings + np.array([0.0, side * 0.052 * h, 0.0]), trousers)
        y = side * 0.052 * h
        build.pillow((-0.045 * h, y - 0.03 * h, 0), (0.11 * h, y + 0.03 * h, 0.05 * h), shoe, 0.5)

    return add


def _arm(
    h: float, side: int, cloth: np.ndarray, colour: np.ndarray
) -> Callable[[MeshBuilder], None]:
    def add(build: MeshBuilder) -> None:
        sleeve, skin = build.material(cloth, (0.3, 0.3)), build.material(colour, (0.3, 0.3))
        y = side * 0.128 * h
        outline = [(0.02, 0.02, 0.46), (0.026, 0.026, 0.62), (0.033, 0.032, 0.75)]
        outline += [(0.034, 0.034, 0.8), (0.012, 0.02, 0.828)]
        build.patch(_rings(np.array(outline) * h) + np.array([0.0, y, 0.0]), sleeve)
        build.pillow(
            (-0.022 * h, y - 0.014 * h, 0.385 * h), (0.03 * h, y + 0.014 * h, 0.475 * h), skin, 0.8
        )

    return add


def _rings(outline: ArrayLike, sides: int = 16) -> np.ndarray:
    """Grid (n, sides + 1, 3) of ellipses with half axes and height (n, 3), seen from outside."""
    a, b, z = np.asarray(outline, dtype=np.float64).T
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    x, y = a[:, None] * np.cos(angle), b[:, None] * np.sin(angle)
    return np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1)


def _cloth(rng: Rng, patterned: bool) -> np.ndarray:
    hue = rng.random()
    if patterned and rng.random() < 0.7:
        colours = [hsv(hue, 0.5, 0.8), hsv(hue + 0.08, 0.7, 0.4), hsv(hue + 0.5, 0.4, 0.6)]
        return fabric.pattern(rng, np.array(colours))
    return fabric.weave(rng, hsv(hue, rng.uniform(0.2, 0.7), rng.uniform(0.25, 0.7)))


def _skin(rng: Rng) -> np.ndarray:
    colour = hsv(rng.uniform(0.04, 0.08), rng.uniform(0.3, 0.55), rng.uniform(0.45, 0.9))
    return grain(rng, colour, (64, 64), (0.05, 1.2))
