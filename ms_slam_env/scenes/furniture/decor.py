"""Pictures, plants, lamps, rugs, curtains, doors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.furniture.small_things import glaze, wood
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric, interior, outdoor
from ms_slam_env.scenes.textures.noise import hsv
from ms_slam_env.scenes.textures.pictures import picture


def picture_frame(build: MeshBuilder, rng: Rng, width_m: float, height_m: float, name: str) -> None:
    """Framed picture hanging with its centre at the origin."""
    size = (256, 384) if width_m > 1.25 * height_m else (256, 256)
    image = build.material(picture(rng, *size))
    kind = rng.random()
    border = (
        build.plain(hsv(0.1, 0.1, rng.uniform(0.05, 0.95)))
        if kind < 0.5
        else wood(build, rng, (0.5, 0.5), 256)
    )
    w, h, b, deep = width_m / 2, height_m / 2, rng.uniform(0.015, 0.045), 0.025
    with build.object(name):
        build.box((-w, -deep, h - b), (w, 0, h), border, "Y")
        build.box((-w, -deep, -h), (w, 0, -h + b), border, "Y")
        build.box((-w, -deep, -h + b), (-w + b, 0, h - b), border, "YzZ")
        build.box((w - b, -deep, -h + b), (w, 0, h - b), border, "YzZ")
        w, h = w - b, h - b
        if kind < 0.35:  # passe-partout
            paper = build.plain((240, 238, 230))
            build.quad((-w, -0.007, -h), (2 * w, 0, 0), (0, 0, 2 * h), paper)
            w, h = 0.75 * w, 0.75 * h
        build.quad((-w, -0.01, -h), (2 * w, 0, 0), (0, 0, 2 * h), image)


def plant(build: MeshBuilder, rng: Rng, height_m: float, name: str) -> None:
    """Pot plant of long arching leaves, centred on the origin."""
    pot_h = 0.25 * height_m
    r = 0.16 * height_m
    with build.object(f"{name} pot"):
        rim = [(r, pot_h), (r, pot_h), (0.9 * r, pot_h), (0.9 * r, pot_h)]
        profile = [(0.7 * r, 0), *rim, (0.88 * r, 0.85 * pot_h)]
        build.lathe(profile, glaze(build, rng), 20)
        soil = build.material(outdoor.soil(rng), (0.2, 0.2))
        build.lathe([(0.89 * r, 0.85 * pot_h), (0, 0.88 * pot_h)], soil, 20)
    blade = build.material(outdoor.leaf(rng))
    wide = rng.uniform(0.05, 0.11) * height_m
    t = np.linspace(0, 1, 6)
    with build.object(name):
        for k in range(int(rng.integers(26, 40))):
            length = height_m * rng.uniform(0.45, 0.8)
            angle, rise = 2.4 * k + rng.uniform(-0.3, 0.3), rng.uniform(0.6, 1.45)
            droop = rng.uniform(0.3, 1.3)
            slope = rise - droop * t * 1.6
            out = np.concatenate([[0], np.cumsum(np.cos(slope[1:]))]) * length / 5
            up = np.concatenate([[0], np.cumsum(np.sin(slope[1:]))]) * length / 5
            out *= min(1.0, 0.42 * height_m / max(out.max(), 1e-6))
            half = wide * np.sin(np.pi * np.clip(0.12 + 0.86 * t, 0, 1)) / 2
            radial = np.array([np.cos(angle), np.sin(angle), 0])
            side = np.array([-np.sin(angle), np.cos(angle), 0])
            spine = out[:, None] * radial + (up + 0.85 * pot_h)[:, None] * [0, 0, 1]
            fold = 0.25 * half[:, None] * np.array([0, 0, 1.0])
            grid = np.stack(
                [spine + half[:, None] * side + fold, spine, spine - half[:, None] * side + fold], 1
            )
            build.sheet(grid, blade)


def floor_lamp(build: MeshBuilder, height_m: float, shade_rgb: tuple[float, ...]) -> float:
    """Standing lamp with a conical shade (label "lamp shade"); returns the bulb's height."""
    metal = build.plain((60, 58, 56))
    with build.object("floor lamp"):
        build.lathe(
            [(0.15, 0), (0.15, 0.02), (0.15, 0.02), (0.012, 0.03), (0.012, height_m)], metal, 16
        )
    with build.object("lamp shade"):
        top, low = height_m + 0.02, height_m - 0.28
        paper = build.plain(shade_rgb)
        build.lathe([(0.22, low), (0.14, top)], paper, 24)
        build.lathe([(0.135, top), (0.215, low)], paper, 24)
    return height_m - 0.12


def rug(build: MeshBuilder, rng: Rng, width_m: float, depth_m: float) -> None:
    """Patterned rug centred on the origin, 1 cm thick."""
    with build.object("rug"):
        design = build.material(fabric.rug(rng))
        edge = build.plain((150, 130, 100))
        low, high = (-width_m / 2, -depth_m / 2, 0), (width_m / 2, depth_m / 2, 0.012)
        build.box(low, high, edge, "z", top=design)


def curtain(
    build: MeshBuilder,
    rng: Rng,
    width_m: float,
    height_m: float,
    cloth_image: np.ndarray,
    name: str,
) -> None:
    """Curtain in folds, hanging down from z = 0, centred in x, about y = -0.1."""
    cloth = build.material(cloth_image, (0.5, 0.5))
    s = np.linspace(0, 1, max(16, int(width_m / 0.02)))
    z = np.linspace(-height_m, 0, max(2, int(height_m / 0.12)))
    fold = np.sin(2 * np.pi * round(width_m / 0.11) * s + 0.6 * np.sin(7 * s + rng.uniform(0, 6)))
    depth = 0.032 * (1 - 0.35 * (z - z[0]) / height_m)[:, None] * fold[None, :]
    grid = np.stack(np.broadcast_arrays((s - 0.5)[None, :] * width_m, depth - 0.1, z[:, None]), -1)
    with build.object(name):
        build.sheet(grid, cloth)


def curtain_cloth(rng: Rng) -> np.ndarray:
    """Plain or striped cloth for a pair of curtains."""
    hue = rng.random()
    light, dark = hsv(hue, rng.uniform(0.1, 0.45), 0.8), hsv(hue + 0.04, 0.5, 0.5)
    if rng.random() < 0.5:
        return fabric.weave(rng, light)
    return fabric.pattern(rng, np.array([light, dark, hsv(hue + 0.5, 0.4, 0.6)]))


def door(build: MeshBuilder, rng: Rng, name: str, rgb: np.ndarray) -> None:
    """Panelled door, 0.85 x 2.05 m, in its casing, on the wall at y = 0."""
    paint = build.material(interior.plaster(rng, rgb, 0.8, 256), (1.0, 1.0))
    trim = build.plain((228, 224, 214))
    metal = build.plain((150, 148, 140))
    with build.object(name):
        build.box((-0.425, -0.012, 0), (0.425, 0, 2.05), paint, "zY")
        _panels_and_handle(build, paint, metal)
    with build.object(f"{name} casing"):
        _casing(build, trim)


_PANELS_X_M, _PANELS_Z_M = (-0.34, 0.03), ((0.15, 0.85), (1.05, 1.9))


def _panels_and_handle(
    build: MeshBuilder, paint: Material, metal: Material, is_mirrored: bool = False
) -> None:
    """One face of a leaf of 0.85 x 2.05 m: panels, a handle at high x (low x if mirrored)."""
    for low, high in _PANELS_Z_M:
        for x in _PANELS_X_M:
            build.box((x, -0.028, low), (x + 0.31, -0.012, high), paint, "Y")
            build.box((x + 0.05, -0.034, low + 0.05), (x + 0.26, -0.028, high - 0.05), paint)
    stem, lever = (0.34, 0.36), (0.26, 0.37)
    if is_mirrored:
        stem, lever = (-0.36, -0.34), (-0.37, -0.26)
    build.box((stem[0], -0.06, 1.0), (stem[1], -0.012, 1.02), metal, "Y")
    build.box((lever[0], -0.075, 0.995), (lever[1], -0.06, 1.02), metal)


def _casing(build: MeshBuilder, trim: Material, half_m: float = 0.425) -> None:
    """Frame around a doorway ``2 * half_m`` wide and 2.05 m high, on the wall at y = 0."""
    wide = half_m + 0.095
    build.box((-wide, -0.03, 0), (-half_m, 0, 2.14), trim, "zY")
    build.box((half_m, -0.03, 0), (wide, 0, 2.14), trim, "zY")
    build.box((-half_m, -0.03, 2.05), (half_m, 0, 2.14), trim, "YxX")


def doorway(build: MeshBuilder, rng: Rng, name: str, width_m: float, wall_m: float) -> None:
    """Lining, casings and threshold of a doorway; its wall is centred at y = 0, along x."""
    trim = build.plain((228, 224, 214))
    half, deep = width_m / 2, wall_m / 2
    with build.object(f"{name} casing"):
        for side in (0, 1):
            with build.frame((0, (2 * side - 1) * deep, 0), np.pi * side):
                _casing(build, trim, half)
        build.quad((-half, -deep, 0), (0, wall_m, 0), (0, 0, 2.05), trim)
        build.quad((half, deep, 0), (0, -wall_m, 0), (0, 0, 2.05), trim)
        build.quad((-half, deep, 2.05), (width_m, 0, 0), (0, -wall_m, 0), trim)
    with build.object(f"{name} threshold"):
        board = wood(build, rng, (0.5, 0.5), 256)
        build.quad((-half, -deep, 0), (width_m, 0, 0), (0, wall_m, 0), board)


def open_leaf(
    build: MeshBuilder, rng: Rng, name: str, rgb: np.ndarray, hinge: int, angle_rad: float
) -> None:
    """Leaf of 0.85 m that hangs at the origin, open to -y by an angle.

    Closed it would lie along -x (``hinge`` 1) or along x (``hinge`` -1).
    """
    paint = build.material(interior.plaster(rng, rgb, 0.8, 256), (1.0, 1.0))
    metal = build.plain((150, 148, 140))
    with (
        build.object(name),
        build.frame((0, 0, 0), hinge * angle_rad),
        build.frame((-hinge * 0.425, 0.02, 0.005)),
    ):
        for side in (0, 1):
            with build.frame((0, (2 * side - 1) * 0.008, 0), np.pi * side):
                for x, z, wide, high in _stiles_and_rails():
                    build.quad((x, -0.012, z), (wide, 0, 0), (0, 0, high), paint, (x, z))
                _panels_and_handle(build, paint, metal, (hinge < 0) == (side == 1))
        for x in (-0.425, 0.425):
            away = np.sign(x)
            build.quad((x, -0.02 * away, 0), (0, 0.04 * away, 0), (0, 0, 2.05), paint)
        build.quad((-0.425, -0.02, 2.05), (0.85, 0, 0), (0, 0.04, 0), paint)


def _stiles_and_rails() -> Iterator[tuple[float, float, float, float]]:
    """Lower x and z, width and height of a leaf's parts beside its panels.

    They must not extend beneath a panel: the baked light there is that of a box's inside, and would
    spread to the visible part.
    """
    for x, end in ((-0.425, -0.34), (-0.03, 0.03), (0.34, 0.425)):
        yield x, 0.0, end - x, 2.05
    for x in _PANELS_X_M:
        for z, end in ((0.0, 0.15), (0.85, 1.05), (1.9, 2.05)):
            yield x, z, 0.31, end - z


def ceiling_lamp(build: MeshBuilder, width_m: float, depth_m: float, name: str) -> None:
    """Flat glowing panel hanging 4 cm under the origin."""
    with build.object(name):
        w, d = width_m / 2, depth_m / 2
        build.box((-w, -d, -0.04), (w, d, 0), build.plain((250, 248, 240)), "Z")


def light_switch(build: MeshBuilder, name: str) -> None:
    """Switch plate of 8 cm, centred at the origin."""
    white = build.plain((236, 234, 228))
    with build.object(name):
        build.box((-0.04, -0.008, -0.04), (0.04, 0, 0.04), white, "Y")
        build.box((-0.02, -0.013, -0.028), (0.02, -0.008, 0.028), build.plain((215, 213, 206)), "Y")
