"""Kitchens and bathrooms: counters, cupboards, refrigerator, bath, washbasin, toilet."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric, interior, pictures
from ms_slam_env.scenes.textures.noise import hsv

COUNTER_M = 0.9
"""Height of a kitchen's worktop."""
DEPTH_M = 0.62
_UNIT_M = 0.6
_WHITE = (238, 238, 234)


def _hollow(
    build: MeshBuilder,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    material: Material,
    rim: float = 0.86,
) -> None:
    """The top of a block with a rounded basin, from its border inwards and down.

    The block spans [low, high]; the basin reaches down to the height of ``low``.
    """
    lo, hi = np.asarray(low), np.asarray(high)
    middle, half = (lo + hi)[:2] / 2, (hi - lo)[:2] / 2
    angle = np.linspace(0, 2 * np.pi, 33)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    square = unit / np.abs(unit).max(axis=1, keepdims=True)
    rounded = np.sign(unit) * np.abs(unit) ** 0.45
    rings = [square, rim * rounded, 0.97 * rim * rounded, 0.88 * rim * rounded]
    rings += [0.7 * rim * rounded, 0.0 * rounded]
    heights = [hi[2], hi[2], 0.85 * hi[2] + 0.15 * lo[2], 0.25 * hi[2] + 0.75 * lo[2]]
    heights += [lo[2], lo[2]]
    grid = np.stack(
        [
            np.concatenate([middle + half * ring, np.full((len(ring), 1), z)], 1)
            for ring, z in zip(rings, heights, strict=True)
        ]
    )
    build.patch(grid, material, inset=False)


def _tap(build: MeshBuilder, z: float) -> None:
    """Tap at the origin's (x, y), its spout towards -y."""
    metal = build.plain((188, 190, 192))
    build.lathe([(0.025, z), (0.025, z + 0.02), (0.013, z + 0.025), (0.013, z + 0.2)], metal, 12)
    build.box((-0.011, -0.17, z + 0.19), (0.011, 0.012, z + 0.212), metal)
    build.box((-0.01, -0.17, z + 0.165), (0.01, -0.15, z + 0.19), metal, "Z")


def counter(
    build: MeshBuilder, rng: Rng, width_m: float, front: Material, name: str = "counter"
) -> None:
    """Kitchen units under one worktop, at y = 0: sink, drawers, hob over an oven; cupboards."""
    stone = build.material(
        interior.tiles(rng, hsv(0.09, 0.1, rng.uniform(0.3, 0.75)), 2), (1.1, 1.1)
    )
    steel, dark = build.plain((176, 178, 180)), build.plain((26, 26, 28))
    half, units = width_m / 2, max(2, round(width_m / _UNIT_M))
    wide, top = width_m / units, COUNTER_M
    sink, hob = (0, units - 1) if rng.random() < 0.5 else (units - 1, 0)
    with build.object(name):
        build.box((-half, -0.58, 0.1), (half, 0, top - 0.04), front, "zZY")
        build.box((-half, -0.52, 0), (half, 0, 0.1), dark, "zZY")
        for k in range(units):
            low = -half + k * wide
            _unit(build, low, wide, front, steel, drawers=k not in (sink, hob) and k % 2 == 0)
            with build.frame((low, 0, 0)):
                if k == sink:
                    build.quad((0, -0.62, top), (wide, 0, 0), (0, 0.08, 0), stone)
                    build.quad((0, -0.1, top), (wide, 0, 0), (0, 0.1, 0), stone)
                else:
                    build.quad((0, -0.62, top), (wide, 0, 0), (0, 0.62, 0), stone)
        build.box((-half, -0.62, top - 0.04), (half, 0, top), stone, "ZY")
    x = -half + sink * wide
    with build.object(f"{name} sink"):
        _hollow(build, (x, -0.54, top - 0.17), (x + wide, -0.1, top + 0.002), steel)
        with build.frame((x + wide / 2, -0.05, 0)):
            _tap(build, top)
    x = -half + hob * wide
    with build.object(f"{name} hob"):
        build.box((x + 0.04, -0.55, top), (x + wide - 0.04, -0.08, top + 0.006), dark, "z")
        for a, b, r in (
            (0.3, -0.42, 0.09),
            (0.7, -0.42, 0.07),
            (0.3, -0.2, 0.07),
            (0.7, -0.2, 0.09),
        ):
            ring = [(r, top + 0.007), (0.85 * r, top + 0.008), (0.8 * r, top + 0.007)]
            build.lathe(ring, steel, 20, (x + a * wide, b, 0))
    with build.object(f"{name} oven"):
        build.box((x + 0.02, -0.61, 0.16), (x + wide - 0.02, -0.6, top - 0.16), dark, "Y")
        build.box((x + 0.06, -0.65, top - 0.24), (x + wide - 0.06, -0.61, top - 0.22), steel)
        for k in range(4):
            low = x + wide * (0.2 + 0.18 * k)
            build.box((low, -0.625, top - 0.12), (low + 0.035, -0.6, top - 0.085), steel, "Y")


def _unit(
    build: MeshBuilder, x: float, wide: float, front: Material, metal: Material, drawers: bool
) -> None:
    """Front of one unit: a door, or three drawers."""
    edges = [0.12, 0.38, 0.62, 0.84] if drawers else [0.12, 0.84]
    for low, high in pairwise(edges):
        a, b = (x + 0.006, -0.6, low + 0.005), (x + wide - 0.006, -0.58, high - 0.005)
        build.box(a, b, front, "Y")
        grip = (x + 0.3 * wide, -0.622, high - 0.06)
        build.box(grip, (x + 0.7 * wide, -0.6, high - 0.045), metal, "Y")


def wall_cupboard(build: MeshBuilder, width_m: float, front: Material, name: str) -> None:
    """Cupboard on the wall, its lower edge at the origin, 0.7 m high, a door every 0.6 m."""
    metal = build.plain((176, 178, 180))
    half, count = width_m / 2, max(1, round(width_m / _UNIT_M))
    wide = width_m / count
    with build.object(name):
        build.box((-half, -0.33, 0), (half, 0, 0.7), front, "Y")
        for k in range(count):
            x = -half + k * wide
            build.box((x + 0.005, -0.35, 0.005), (x + wide - 0.005, -0.33, 0.695), front, "Y")
            grip = x + (wide - 0.07 if k % 2 == 0 else 0.05)
            build.box((grip, -0.37, 0.05), (grip + 0.015, -0.35, 0.18), metal, "Y")


def refrigerator(build: MeshBuilder, rng: Rng, name: str = "refrigerator") -> None:
    """Refrigerator of 0.6 x 0.63 x 1.8 m with notes and photographs on its door."""
    paint = build.plain(np.array(rng.choice([[236, 236, 232], [190, 194, 198]])))
    metal = build.plain((150, 152, 154))
    with build.object(name):
        build.box((-0.3, -0.6, 0.03), (0.3, 0, 1.8), paint, "z")
        for low, high in ((0.05, 1.18), (1.2, 1.79)):
            build.box((-0.298, -0.63, low), (0.298, -0.6, high), paint, "Y")
            near = high - 0.5 if low < 1 else low + 0.05
            build.box((0.23, -0.665, near), (0.25, -0.63, near + 0.4), metal, "Y")
    for k in range(int(rng.integers(3, 7))):
        w, h = rng.uniform(0.06, 0.16, 2)
        x, z = rng.uniform(-0.25, 0.1), rng.uniform(0.75, 1.0) + 0.5 * (k % 2)
        with build.object(f"{name} note {k}"):
            sheet = build.material(pictures.cover(rng, 96, 96))
            build.quad((x, -0.632, z), (w, 0, 0), (0, 0, h), sheet)


def bath(build: MeshBuilder, name: str = "bath") -> None:
    """Bathtub of 1.7 x 0.75 m along the wall, its tap at low x."""
    white = build.plain(_WHITE)
    with build.object(name):
        build.box((-0.85, -0.75, 0), (0.85, 0, 0.56), white, "zZ")
        _hollow(build, (-0.85, -0.75, 0.14), (0.85, 0, 0.56), white, 0.88)
    with build.object(f"{name} tap"), build.frame((-0.7, -0.04, 0)):
        _tap(build, 0.56)


def washbasin(build: MeshBuilder, rng: Rng, front: Material, name: str = "washbasin") -> None:
    """Basin of 0.65 x 0.48 m on a cabinet with two doors, things beside the tap."""
    white, metal = build.plain(_WHITE), build.plain((176, 178, 180))
    with build.object(name):
        build.box((-0.3, -0.42, 0.2), (0.3, 0, 0.72), front, "Z")
        for low, high in ((-0.295, -0.005), (0.005, 0.295)):
            build.box((low, -0.44, 0.21), (high, -0.42, 0.71), front, "Y")
            grip = high - 0.04 if low < 0 else low + 0.02
            build.box((grip, -0.46, 0.5), (grip + 0.02, -0.44, 0.62), metal, "Y")
        build.box((-0.325, -0.48, 0.72), (0.325, 0, 0.85), white, "Z")
        _hollow(build, (-0.325, -0.48, 0.74), (0.325, -0.1, 0.85), white, 0.82)
        build.quad((-0.325, -0.1, 0.85), (0.65, 0, 0), (0, 0.1, 0), white)
        with build.frame((0, -0.05, 0)):
            _tap(build, 0.85)
    for k, x in enumerate((-0.24, 0.22)):
        with build.object(f"bathroom bottle {k}"):
            tone = build.plain(hsv(rng.random(), 0.5, rng.uniform(0.4, 0.9)))
            tall = rng.uniform(0.12, 0.2)
            shape = [(0.028, 0.85), (0.028, 0.85 + 0.7 * tall), (0.01, 0.85 + 0.8 * tall)]
            build.lathe([*shape, (0.01, 0.85 + tall), (0, 0.85 + tall)], tone, 12, (x, -0.05, 0))


def mirror_cabinet(build: MeshBuilder, front: Material, name: str = "mirror cabinet") -> None:
    """Cabinet on the wall, 0.6 x 0.65 m, centred at the origin."""
    metal = build.plain((176, 178, 180))
    with build.object(name):
        build.box((-0.3, -0.14, -0.325), (0.3, 0, 0.325), front, "Y")
        for low, high in ((-0.296, -0.003), (0.003, 0.296)):
            build.box((low, -0.155, -0.32), (high, -0.14, 0.32), front, "Y")
            grip = high - 0.03 if low < 0 else low + 0.015
            build.box((grip, -0.17, -0.25), (grip + 0.015, -0.155, -0.13), metal, "Y")


def toilet(build: MeshBuilder, name: str = "toilet") -> None:
    """Bowl with its lid closed, 0.66 m deep, and cistern."""
    white = build.plain(_WHITE)
    with build.object(name):
        build.pillow((-0.19, -0.19, 0.38), (0.19, -0.01, 0.8), white, 0.2)
        build.box((-0.1, -0.5, 0), (0.1, -0.1, 0.2), white, "z")
        build.pillow((-0.18, -0.66, 0.1), (0.18, -0.08, 0.41), white, 0.7)
        build.pillow((-0.19, -0.67, 0.4), (0.19, -0.18, 0.45), white, 0.6)
    with build.object(f"{name} button"):
        build.lathe(
            [(0.03, 0.79), (0.03, 0.81), (0, 0.81)], build.plain((150, 152, 154)), 14, (0, -0.1, 0)
        )


def washing_machine(build: MeshBuilder, name: str = "washing machine") -> None:
    """Machine of 0.6 x 0.6 x 0.85 m with a round window."""
    white, dark, steel = (
        build.plain(_WHITE),
        build.plain((34, 36, 40)),
        build.plain((170, 172, 176)),
    )
    with build.object(name):
        build.box((-0.3, -0.58, 0.02), (0.3, 0, 0.85), white, "z")
        build.box((-0.29, -0.59, 0.72), (0.29, -0.58, 0.83), build.plain((214, 214, 212)), "Y")
        with build.frame((0, -0.58, 0.4), pitch=np.pi / 2):
            build.lathe([(0.22, 0), (0.21, 0.035), (0.16, 0.035), (0.15, 0.01)], steel, 26)
            build.lathe([(0.15, 0.01), (0, 0.03)], dark, 26)
        with build.frame((0.18, -0.59, 0.775), pitch=np.pi / 2):
            build.lathe([(0.035, 0), (0.03, 0.02), (0, 0.02)], steel, 16)


def radiator(build: MeshBuilder, width_m: float, name: str = "radiator") -> None:
    """Ribbed radiator in front of the wall at y = 0, from 0.12 to 0.68 m above the floor."""
    white = build.plain((232, 232, 226))
    half = width_m / 2
    with build.object(name):
        for x in np.arange(-half, half - 0.03, 0.06):
            build.box((x, -0.1, 0.12), (x + 0.045, -0.03, 0.68), white)
        build.box((-half, -0.075, 0.16), (half, -0.055, 0.2), white)
        build.box((-half, -0.075, 0.6), (half, -0.055, 0.64), white)


def towel_rail(build: MeshBuilder, rng: Rng, name: str = "towel") -> None:
    """Rail of 0.6 m on the wall at the origin's height, a towel over it."""
    metal = build.plain((176, 178, 180))
    hue = rng.random()
    colours = np.array([hsv(hue, 0.2, 0.9), hsv(hue, 0.6, 0.6), hsv(hue + 0.5, 0.3, 0.7)])
    cloth = build.material(fabric.pattern(rng, colours), (0.35, 0.35))
    with build.object(f"{name} rail"):
        build.box((-0.3, -0.08, -0.01), (0.3, -0.06, 0.01), metal)
        for x in (-0.3, 0.28):
            build.box((x, -0.06, -0.01), (x + 0.02, 0, 0.01), metal, "Y")
    z = np.array([-0.55, -0.3, -0.1, 0.0, 0.015, 0.0, -0.1, -0.3, -0.4])
    y = np.array([-0.095, -0.095, -0.09, -0.085, -0.07, -0.055, -0.05, -0.045, -0.045])
    across = np.linspace(-0.2, 0.2, 7)
    wave = 0.004 * np.sin(np.arange(7) * 1.7)[None, :]
    grid = np.stack(np.broadcast_arrays(across[None, :], y[:, None] + wave, z[:, None]), -1)
    with build.object(name):
        build.sheet(grid, cloth)
