"""Racks with boxes, crates on pallets, machines, steel columns, pipes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder, pick
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import industrial, interior
from ms_slam_env.scenes.textures.noise import hsv

RACK_DEPTH_M = 1.1
BAY_M = 2.4


@dataclass(frozen=True)
class Stock:
    """Materials shared by the objects in a hall, so that many look alike."""

    boxes: tuple[Material, ...]
    crates: tuple[Material, ...]
    panels: tuple[Material, ...]
    paints: tuple[Material, ...]
    upright: Material
    beam: Material
    deck: Material
    pallet: Material
    hazard: Material


def stock(build: MeshBuilder, rng: Rng) -> Stock:
    """Draw the materials of a hall."""
    paints = [hsv(rng.random(), rng.uniform(0.2, 0.7), rng.uniform(0.4, 0.8)) for _ in range(4)]
    return Stock(
        boxes=tuple(build.material(industrial.cardboard(rng)) for _ in range(8)),
        crates=tuple(build.material(industrial.crate(rng)) for _ in range(3)),
        panels=tuple(build.material(industrial.control_panel(rng, paint)) for paint in paints),
        paints=tuple(
            build.material(industrial.corrugated(rng, paint, 6, 256), (1.2, 1.2))
            for paint in paints
        ),
        upright=build.plain((38, 74, 138)),
        beam=build.plain((222, 108, 30)),
        deck=build.material(interior.board(rng, (170, 150, 120), 256), (0.8, 0.8)),
        pallet=build.material(interior.board(rng, (182, 146, 96), 256), (0.6, 0.6)),
        hazard=build.material(industrial.hazard(), (0.4, 0.4)),
    )


def rack(build: MeshBuilder, rng: Rng, of: Stock, bays: int, levels: int, name: str) -> None:
    """Pallet rack along x from the origin, ``RACK_DEPTH_M`` deep in y, goods on every level."""
    step = 1.35
    height = step * levels + 0.3
    with build.object(name):
        for bay in range(bays + 1):
            x = bay * BAY_M
            for y in (0.0, RACK_DEPTH_M - 0.09):
                build.box((x - 0.05, y, 0), (x + 0.05, y + 0.09, height), of.upright, "z")
            build.box((x - 0.07, -0.03, 0), (x + 0.07, 0.13, 0.45), of.hazard, "z")
            for z in np.arange(0.5, height - 0.4, 1.0):
                build.box(
                    (x - 0.02, 0.09, z), (x + 0.02, RACK_DEPTH_M - 0.09, z + 0.05), of.upright
                )
        for bay in range(bays):
            low, high = bay * BAY_M + 0.05, (bay + 1) * BAY_M - 0.05
            for level in range(1, levels):
                z = level * step
                for y in (0.0, RACK_DEPTH_M - 0.06):
                    build.box((low, y, z - 0.12), (high, y + 0.06, z), of.beam, "xX")
                build.box((low, 0.04, z), (high, RACK_DEPTH_M - 0.04, z + 0.03), of.deck, "xX")
    for bay in range(bays):
        for level in range(levels):
            with build.frame((bay * BAY_M + 0.12, 0.06, level * step + 0.03 * (level > 0))):
                goods(build, rng, of, BAY_M - 0.3, step - 0.3, f"{name} goods {bay}.{level}")


def goods(build: MeshBuilder, rng: Rng, of: Stock, width: float, height: float, name: str) -> None:
    """Two pallets side by side with boxes or a crate on them; sometimes one is empty."""
    for side in range(2):
        if rng.random() < 0.12:
            continue
        with build.object(f"{name} {side}"):
            x = side * width / 2
            with build.frame((x + 0.03, rng.uniform(0.0, 0.06), 0)):
                pallet_load(build, rng, of, width / 2 - 0.1, height)


def pallet_load(build: MeshBuilder, rng: Rng, of: Stock, width: float, height: float) -> None:
    """A pallet from the origin with a crate or rows of boxes, at most ``height`` high."""
    deep = 0.9
    for y in (0.0, 0.4, 0.8):
        build.box((0, y, 0), (width, y + 0.1, 0.1), of.pallet, "z")
    build.box((0, 0, 0.1), (width, deep, 0.13), of.pallet)
    if rng.random() < 0.3:
        crate = pick(rng, of.crates)
        high = height * rng.uniform(0.7, 0.95)
        build.box((0.03, 0.04, 0.13), (width - 0.03, deep - 0.04, high), crate, "z")
        return
    layers = int(rng.integers(1, 3))
    each = (height * rng.uniform(0.7, 0.98) - 0.13) / layers
    columns = int(rng.integers(1, 3))
    kind = pick(rng, of.boxes)
    for layer in range(layers):
        for column in range(columns):
            if layer == layers - 1 and columns > 1 and rng.random() < 0.2:
                continue
            w = width / columns
            x, y = column * w + rng.uniform(0.0, 0.03), rng.uniform(0.0, 0.06)
            z = 0.13 + layer * each
            build.box((x, y, z), (x + w - 0.04, deep - 0.06 + y, z + each - 0.01), kind, "z")


def machine(build: MeshBuilder, rng: Rng, of: Stock, name: str) -> None:
    """Machine tool of about 2.4 x 1.5 x 2 m, front on y = 0 facing -y, from x = 0."""
    w, d, h = rng.uniform(2.0, 2.8), rng.uniform(1.2, 1.6), rng.uniform(1.6, 2.2)
    k = int(rng.integers(len(of.paints)))
    paint, panel = of.paints[k], pick(rng, of.panels)
    dark, glass = build.plain((44, 46, 50)), build.plain((70, 92, 104))
    with build.object(name):
        build.box((0, 0, 0.12), (w, d, h), paint, "z")
        build.box((0.06, 0.06, 0), (w - 0.06, d - 0.06, 0.12), dark, "zZ")
        build.box((0.3, -0.05, 0.9), (0.6 * w, 0, h - 0.25), dark, "Y")
        build.box((0.38, -0.07, 0.98), (0.6 * w - 0.08, -0.05, h - 0.33), glass, "Y")
        build.box((0.66 * w, -0.22, 0.85), (w - 0.08, 0, 1.65), paint, "Y", front=panel)
        build.box((0.0, -0.02, 0.12), (w, 0, 0.34), of.hazard, "Y")
        build.lathe([(0.22, h), (0.22, h + 0.5), (0.1, h + 0.55)], dark, 12, (0.3 * w, 0.5 * d, 0))
        build.lathe([(0.05, h), (0.05, h + 0.4)], build.plain((60, 60, 60)), 8, (w - 0.2, 0.2, 0))
        for n, colour in enumerate(((60, 190, 80), (230, 180, 40), (210, 50, 40))):
            low = h + 0.4 + 0.1 * n
            lamp = [(0.06, low), (0.06, low + 0.09), (0, low + 0.1)]
            build.lathe(lamp, build.plain(colour), 8, (w - 0.2, 0.2, 0))


def column(build: MeshBuilder, of: Stock, height_m: float, name: str) -> None:
    """Steel H-section column at the origin, hazard stripes at its foot."""
    steel = build.plain((126, 134, 138))
    with build.object(name):
        for low, high in (
            ((-0.16, -0.16), (0.16, -0.13)),
            ((-0.16, 0.13), (0.16, 0.16)),
            ((-0.02, -0.13), (0.02, 0.13)),
        ):
            build.box((*low, 0), (*high, height_m), steel, "zZ")
        build.box((-0.22, -0.22, 0), (0.22, 0.22, 1.1), of.hazard, "z")


def drum(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Steel drum at the origin."""
    paint = hsv(rng.choice([0.0, 0.12, 0.36, 0.6]), 0.7, rng.uniform(0.35, 0.7))
    metal = build.material(industrial.corrugated(rng, paint, 3, 64), (0.9, 0.9))
    profile = [(0.29, 0.0)]
    for z in (0.3, 0.6):
        profile += [(0.29, z - 0.02), (0.31, z), (0.29, z + 0.02)]
    with build.object(name):
        build.lathe([*profile, (0.29, 0.88), (0.29, 0.88), (0, 0.87)], metal, 16)
