"""Shelves with books and small things, TV stand, chest of drawers."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.furniture import tableware
from ms_slam_env.scenes.textures import printed, wood


def book_row(
    build: MeshBuilder, rng: np.random.Generator, length_m: float, height_m: float, name: str
) -> None:
    """Books standing side by side from x = 0 to at most ``length_m``, spines at -y."""
    sheet = printed.spines(rng)
    pages = build.plain((225, 218, 200))
    slot = 1.0 / printed.SPINE_SLOTS
    x = 0.0
    with build.object(name):
        while True:
            wide = rng.uniform(0.018, 0.05)
            if x + wide > length_m:
                return
            k = int(rng.integers(printed.SPINE_SLOTS))
            tall, deep = height_m * rng.uniform(0.68, 0.96), rng.uniform(0.15, 0.22)
            y = -0.24 + rng.uniform(0, 0.02)
            region = ((k + 0.04) * slot, 0.002, (k + 0.96) * slot, 0.998)
            spine = build.material(sheet)
            front = Material(spine.texture, None, region)
            middle = (k + 0.5) * slot
            side = Material(spine.texture, None, (middle, 0.0, middle + 0.1 * slot, 0.06))
            build.box((x, y, 0), (x + wide, y + deep, tall), side, "zY", top=pages, front=front)
            x += wide + (rng.uniform(0.0, 0.004) if rng.random() < 0.9 else rng.uniform(0.02, 0.08))


def bookshelf(
    build: MeshBuilder,
    rng: np.random.Generator,
    width_m: float = 1.0,
    height_m: float = 2.0,
    shelves: int = 5,
    name: str = "bookshelf",
) -> None:
    """Open shelf of boards; each level holds books, or books and an ornament."""
    material = build.material(wood.board(rng), (0.8, 0.8))
    half, depth, thick = width_m / 2, 0.3, 0.022
    step = (height_m - 0.06 - thick) / shelves
    with build.object(name):
        for x in (-half, half - thick):
            build.box((x, -depth, 0), (x + thick, 0, height_m), material, "z")
        for k in range(shelves + 1):
            z = 0.06 + k * step
            build.box((-half + thick, -depth, z), (half - thick, -0.008, z + thick), material, "xX")
        build.quad((-half, -0.008, 0.02), (width_m, 0, 0), (0, 0, height_m - 0.02), material)
    for k in range(shelves):
        z = 0.06 + k * step + thick
        inner = width_m - 2 * thick - 0.02
        share = rng.choice([1.0, rng.uniform(0.45, 0.75)])
        with build.frame((-half + thick + 0.01, -0.02, z)):
            book_row(build, rng, inner * share, step - thick, f"{name} books {k}")
        if share < 1.0:
            with build.frame((half - 0.5 * inner * (1 - share) - thick, -0.03, z)):
                tableware.ornament(
                    build,
                    rng,
                    0.75 * (step - thick),
                    0.4 * inner * (1 - share),
                    f"{name} ornament {k}",
                )


def tv_stand(build: MeshBuilder, rng: np.random.Generator, width_m: float) -> float:
    """Low cabinet with two drawers and an open middle; returns the height of its top."""
    material = build.material(wood.board(rng), (0.9, 0.9))
    dark = build.plain((40, 36, 34))
    half, depth, height = width_m / 2, 0.42, rng.uniform(0.4, 0.52)
    with build.object("TV stand"):
        build.box((-half, -depth, height - 0.03), (half, 0, height), material)
        build.box((-half, -depth, 0.06), (half, 0, 0.09), material)
        for low, high in ((-half, -half / 3), (half / 3, half)):
            build.box((low, -depth + 0.005, 0.09), (high, 0, height - 0.03), material, "zZ")
            build.box(
                (low + 0.02, -depth - 0.012, 0.11),
                (high - 0.02, -depth + 0.01, height - 0.05),
                material,
                "Y",
            )
            middle = (low + high) / 2
            build.box(
                (middle - 0.06, -depth - 0.03, height * 0.55),
                (middle + 0.06, -depth - 0.01, height * 0.55 + 0.015),
                dark,
            )
        build.quad((-half / 3, -0.03, 0.09), (2 * half / 3, 0, 0), (0, 0, height - 0.12), dark)
        for x in (-half + 0.04, half - 0.08):
            build.box((x, -depth + 0.03, 0), (x + 0.04, -0.03, 0.06), dark, "zZ")
    with build.object("media player"):
        build.box((-half / 4, -0.36, 0.09), (half / 4, -0.1, 0.14), build.plain((28, 28, 32)))
    return height


def drawers(
    build: MeshBuilder, rng: np.random.Generator, width_m: float, height_m: float, name: str
) -> None:
    """Chest of drawers with knobs."""
    material = build.material(wood.board(rng), (0.8, 0.8))
    knob = build.plain((190, 170, 110))
    half, depth, count = width_m / 2, 0.45, max(2, round(height_m / 0.25))
    step = (height_m - 0.1) / count
    with build.object(name):
        build.box((-half, -depth, 0), (half, 0, height_m), material, "zY")
        for k in range(count):
            z = 0.06 + k * step
            build.box(
                (-half + 0.03, -depth - 0.018, z),
                (half - 0.03, -depth + 0.01, z + step - 0.025),
                material,
                "Y",
            )
            for x in (-half / 2, half / 2):
                build.pillow(
                    (x - 0.018, -depth - 0.05, z + step / 2 - 0.02),
                    (x + 0.018, -depth - 0.015, z + step / 2 + 0.016),
                    knob,
                    1.0,
                )


def wall_shelf(
    build: MeshBuilder, rng: np.random.Generator, width_m: float, name: str = "shelf"
) -> None:
    """Board on two brackets, top at z = 0, with books and an ornament on it."""
    material = build.material(wood.board(rng, size=256), (0.6, 0.6))
    half = width_m / 2
    with build.object(name):
        build.box((-half, -0.24, -0.025), (half, 0, 0), material)
        for x in (-half * 0.7, half * 0.7):
            build.box((x - 0.012, -0.2, -0.12), (x + 0.012, 0, -0.025), material)
    with build.frame((-half + 0.04, 0, 0)):
        book_row(build, rng, width_m * 0.5, 0.24, f"{name} books")
    with build.frame((half * 0.55, -0.02, 0)):
        tableware.ornament(build, rng, 0.2, 0.09, f"{name} ornament")
