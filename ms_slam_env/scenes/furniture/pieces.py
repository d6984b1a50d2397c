"""Sofas, chairs, tables, shelves with books, chests of drawers; beds, wardrobes, coats, toys."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.furniture import small_things
from ms_slam_env.scenes.furniture.small_things import wood
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric, pictures
from ms_slam_env.scenes.textures.noise import Image, grain, hsv


def upholstery(build: MeshBuilder, rng: Rng) -> Material:
    """Woven fabric of a muted colour."""
    colour = hsv(rng.random(), rng.uniform(0.08, 0.55), rng.uniform(0.3, 0.75))
    return build.material(fabric.weave(rng, colour), (0.25, 0.25))


def throw_pillow(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Patterned pillow of 40 cm leaning back, standing on its lower edge."""
    hue = rng.random()
    colours = np.array([hsv(hue, 0.25, 0.85), hsv(hue + 0.05, 0.7, 0.5), hsv(hue + 0.5, 0.5, 0.4)])
    cloth = build.material(fabric.pattern(rng, colours), None)
    with build.object(name), build.frame((0, -0.1, 0.0), pitch=-0.35):
        build.pillow((-0.21, -0.08, 0.0), (0.21, 0.08, 0.4), cloth, 0.55)


def sofa(build: MeshBuilder, rng: Rng, width_m: float, seats: int, name: str = "sofa") -> None:
    """Upholstered seat with arms, back, loose cushions and a few throw pillows."""
    cloth = upholstery(build, rng)
    leg = wood(build, rng, (0.4, 0.4), 256)
    depth, arm, seat, back = 0.9, rng.uniform(0.14, 0.22), 0.42, rng.uniform(0.78, 0.9)
    half = width_m / 2
    with build.object(name):
        for x in (-half + 0.06, half - 0.12):
            for y in (-depth + 0.06, -0.12):
                build.box((x, y, 0), (x + 0.06, y + 0.06, 0.12), leg, "zZ")
        build.box((-half, -depth + 0.02, 0.12), (half, 0, 0.28), cloth)
        for side in (-1, 1):
            low, high = sorted((side * half, side * (half - arm)))
            build.pillow((low, -depth, 0.14), (high, 0, 0.62), cloth, 0.25)
        build.pillow((-half + 0.02, -0.24, 0.14), (half - 0.02, 0, back), cloth, 0.25)
        edges = np.linspace(-half + arm, half - arm, seats + 1)
        for low, high in pairwise(edges):
            build.pillow((low, -depth - 0.02, 0.24), (high, -0.18, seat + 0.03), cloth, 0.28)
            build.pillow((low, -0.42, seat - 0.02), (high, -0.16, back + 0.06), cloth, 0.4)
    for k in range(min(seats, int(rng.integers(1, 4)))):
        x = (-1 if k % 2 else 1) * (half - arm - 0.25 - 0.3 * (k // 2)) + rng.uniform(-0.05, 0.05)
        with build.frame((x, -0.38, seat), yaw=rng.uniform(-0.4, 0.4)):
            throw_pillow(build, rng, f"{name} pillow {k}")


def chair(build: MeshBuilder, rng: Rng, name: str = "chair") -> None:
    """Wooden chair with a padded seat; stands on its four legs, back at y = 0."""
    frame_wood = wood(build, rng, (0.5, 0.5), 256)
    pad = upholstery(build, rng)
    with build.object(name):
        for x in (-0.21, 0.17):
            build.box((x, -0.44, 0), (x + 0.04, -0.4, 0.44), frame_wood, "zZ")
            build.box((x, -0.04, 0), (x + 0.04, 0, 0.9), frame_wood, "z")
        build.box((-0.22, -0.45, 0.41), (0.22, 0, 0.45), frame_wood)
        build.pillow((-0.21, -0.45, 0.44), (0.21, -0.03, 0.5), pad, 0.35)
        for z in (0.56, 0.68, 0.8):
            build.box((-0.17, -0.03, z), (0.17, -0.01, z + 0.07), frame_wood)


def table(
    build: MeshBuilder,
    width_m: float,
    depth_m: float,
    height_m: float,
    material: Material,
    name: str = "table",
) -> None:
    """Board on four legs with an apron."""
    half, leg, thick = width_m / 2, 0.055, 0.03
    with build.object(name):
        build.box((-half, -depth_m, height_m - thick), (half, 0, height_m), material)
        for x in (-half + 0.03, half - 0.03 - leg):
            for y in (-depth_m + 0.03, -0.03 - leg):
                build.box((x, y, 0), (x + leg, y + leg, height_m - thick), material, "zZ")
        if height_m > 0.55:
            for y in (-depth_m + 0.045, -0.06):
                low = (-half + 0.08, y, height_m - 0.11)
                build.box(low, (half - 0.08, y + 0.02, height_m - thick), material, "xXZ")


def place(
    rng: Rng,
    low: tuple[float, float],
    high: tuple[float, float],
    radii: list[float],
    tries: int = 60,
) -> list[tuple[float, float] | None]:
    """Place discs at random in a rectangle without overlap; None for each that does not fit."""
    placed: list[tuple[float, float, float]] = []
    result: list[tuple[float, float] | None] = []
    for r in radii:
        spot = None
        for _ in range(tries):
            if low[0] + r > high[0] - r or low[1] + r > high[1] - r:
                break
            x = rng.uniform(low[0] + r, high[0] - r)
            y = rng.uniform(low[1] + r, high[1] - r)
            if all(np.hypot(x - a, y - b) > r + c for a, b, c in placed):
                spot = (float(x), float(y))
                placed.append((*spot, r))
                break
        result.append(spot)
    return result


def book_row(build: MeshBuilder, rng: Rng, length_m: float, height_m: float, name: str) -> None:
    """Books standing side by side from x = 0 to at most ``length_m``, spines at -y."""
    sheet = build.stocked(rng, "spines", lambda: pictures.spines(rng))
    pages = build.plain((225, 218, 200))
    slot = 1.0 / pictures.SPINE_SLOTS
    x = 0.0
    with build.object(name):
        while True:
            wide = rng.uniform(0.018, 0.05)
            if x + wide > length_m:
                return
            k = int(rng.integers(pictures.SPINE_SLOTS))
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
    rng: Rng,
    width_m: float = 1.0,
    height_m: float = 2.0,
    shelves: int = 5,
    name: str = "bookshelf",
) -> None:
    """Open shelf of boards; each level holds books, or books and an ornament."""
    material = wood(build, rng, (0.8, 0.8))
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
                size = 0.75 * (step - thick), 0.4 * inner * (1 - share)
                small_things.ornament(build, rng, *size, f"{name} ornament {k}")


def tv_stand(build: MeshBuilder, rng: Rng, width_m: float) -> float:
    """Low cabinet with two drawers and an open middle; returns the height of its top."""
    material = wood(build, rng, (0.9, 0.9))
    dark = build.plain((40, 36, 34))
    half, depth, height = width_m / 2, 0.42, rng.uniform(0.4, 0.52)
    with build.object("TV stand"):
        build.box((-half, -depth, height - 0.03), (half, 0, height), material)
        build.box((-half, -depth, 0.06), (half, 0, 0.09), material)
        for low, high in ((-half, -half / 3), (half / 3, half)):
            build.box((low, -depth + 0.005, 0.09), (high, 0, height - 0.03), material, "zZ")
            front = (high - 0.02, -depth + 0.01, height - 0.05)
            build.box((low + 0.02, -depth - 0.012, 0.11), front, material, "Y")
            x, y, z = (low + high) / 2, -depth - 0.03, height * 0.55
            build.box((x - 0.06, y, z), (x + 0.06, -depth - 0.01, z + 0.015), dark)
        build.quad((-half / 3, -0.03, 0.09), (2 * half / 3, 0, 0), (0, 0, height - 0.12), dark)
        for x in (-half + 0.04, half - 0.08):
            build.box((x, -depth + 0.03, 0), (x + 0.04, -0.03, 0.06), dark, "zZ")
    with build.object("media player"):
        build.box((-half / 4, -0.36, 0.09), (half / 4, -0.1, 0.14), build.plain((28, 28, 32)))
    return height


def drawers(build: MeshBuilder, rng: Rng, width_m: float, height_m: float, name: str) -> None:
    """Chest of drawers with knobs."""
    material = wood(build, rng, (0.8, 0.8))
    knob = build.plain((190, 170, 110))
    half, depth, count = width_m / 2, 0.45, max(2, round(height_m / 0.25))
    step = (height_m - 0.1) / count
    with build.object(name):
        build.box((-half, -depth, 0), (half, 0, height_m), material, "zY")
        for k in range(count):
            z = 0.06 + k * step
            top = (half - 0.03, -depth + 0.01, z + step - 0.025)
            build.box((-half + 0.03, -depth - 0.018, z), top, material, "Y")
            for x in (-half / 2, half / 2):
                low = (x - 0.018, -depth - 0.05, z + step / 2 - 0.02)
                high = (x + 0.018, -depth - 0.015, z + step / 2 + 0.016)
                build.pillow(low, high, knob, 1.0)


def wall_shelf(build: MeshBuilder, rng: Rng, width_m: float, name: str = "shelf") -> None:
    """Board on two brackets, top at z = 0, with books and an ornament on it."""
    material = wood(build, rng, (0.6, 0.6), 256)
    half = width_m / 2
    with build.object(name):
        build.box((-half, -0.24, -0.025), (half, 0, 0), material)
        for x in (-half * 0.7, half * 0.7):
            build.box((x - 0.012, -0.2, -0.12), (x + 0.012, 0, -0.025), material)
    with build.frame((-half + 0.04, 0, 0)):
        book_row(build, rng, width_m * 0.5, 0.24, f"{name} books")
    with build.frame((half * 0.55, -0.02, 0)):
        small_things.ornament(build, rng, 0.2, 0.09, f"{name} ornament")


BED_LENGTH_M = 2.08


def bed(build: MeshBuilder, rng: Rng, width_m: float, name: str = "bed") -> None:
    """Bed with its head at y = 0: frame, mattress, patterned duvet turned back, pillows."""
    oak = wood(build, rng, (0.8, 0.8))
    linen = build.material(fabric.weave(rng, (232, 230, 224)), (0.3, 0.3))
    hue = rng.random()
    colours = np.array([hsv(hue, 0.25, 0.85), hsv(hue, 0.6, 0.5), hsv(hue + 0.45, 0.4, 0.5)])
    cover = build.material(fabric.pattern(rng, colours), (0.9, 0.9))
    half, length = width_m / 2, BED_LENGTH_M
    with build.object(name):
        build.box((-half - 0.03, -0.05, 0), (half + 0.03, 0, rng.uniform(0.85, 1.1)), oak, "z")
        build.box((-half, -length + 0.02, 0.1), (half, -0.05, 0.3), oak)
        for x in (-half + 0.02, half - 0.09):
            build.box((x, -length + 0.06, 0), (x + 0.07, -length + 0.13, 0.1), oak, "zZ")
    with build.object(f"{name} mattress"):
        build.pillow((-half + 0.01, -length + 0.03, 0.27), (half - 0.01, -0.05, 0.5), linen, 0.15)
    with build.object(f"{name} duvet"):
        build.pillow((-half - 0.02, -length - 0.01, 0.32), (half + 0.02, -0.75, 0.6), cover, 0.2)
        build.pillow((-half + 0.01, -0.98, 0.5), (half - 0.01, -0.66, 0.63), linen, 0.4)
    count = 2 if width_m > 1.2 else 1
    for k in range(count):
        x = (k - (count - 1) / 2) * 0.76 + rng.uniform(-0.04, 0.04)
        with build.object(f"{name} pillow {k}"), build.frame((x, -0.1, 0.47), pitch=0.35):
            build.pillow((-0.35, -0.48, 0.0), (0.35, 0.0, 0.17), linen, 0.5)


def wardrobe(
    build: MeshBuilder, rng: Rng, width_m: float, height_m: float, name: str = "wardrobe"
) -> None:
    """Tall cupboard, 0.6 m deep, with a door every half metre."""
    oak = wood(build, rng, (1.0, 1.0))
    metal = build.plain((150, 148, 140))
    half, depth = width_m / 2, 0.58
    count = max(2, round(width_m / 0.5))
    wide = width_m / count
    with build.object(name):
        build.box((-half, -depth, 0.0), (half, 0, height_m), oak, "z")
        build.box((-half - 0.015, -depth - 0.03, height_m), (half + 0.015, 0, height_m + 0.04), oak)
        for k in range(count):
            x = -half + k * wide
            top = (x + wide - 0.008, -depth, height_m - 0.03)
            build.box((x + 0.008, -depth - 0.02, 0.08), top, oak, "Y")
            inner = (x + wide - 0.08, -depth - 0.02, height_m - 0.12)
            build.box((x + 0.08, -depth - 0.028, 0.18), inner, oak, "Y")
            grip = x + (wide - 0.045 if k % 2 == 0 else 0.03)
            low = (grip, -depth - 0.045, 0.98)
            build.box(low, (grip + 0.015, -depth - 0.02, 1.12), metal, "Y")


def table_lamp(build: MeshBuilder, rng: Rng, height_m: float, name: str) -> float:
    """Lamp with a shade (label "lamp shade") standing at the origin; returns its bulb's height."""
    foot = build.plain(hsv(rng.random(), rng.uniform(0.1, 0.6), rng.uniform(0.3, 0.8)))
    with build.object(name):
        stem = [(0.07, 0), (0.07, 0.015), (0.02, 0.03), (0.035, 0.4 * height_m), (0.01, height_m)]
        build.lathe(stem, foot, 14)
    with build.object("lamp shade"):
        paper = build.plain((250, 236, 205))
        low = 0.5 * height_m
        build.lathe([(0.13, low), (0.08, height_m)], paper, 18)
        build.lathe([(0.077, height_m), (0.127, low)], paper, 18)
    return 0.75 * height_m


def coat_rack(build: MeshBuilder, rng: Rng, width_m: float, name: str = "coat rack") -> None:
    """Board with hooks on the wall, its lower edge at the origin, and some coats hanging on it."""
    oak = wood(build, rng, (0.5, 0.5), 256)
    metal = build.plain((120, 118, 110))
    half = width_m / 2
    places = np.arange(-half + 0.12, half - 0.05, 0.2)
    with build.object(name):
        build.box((-half, -0.02, 0), (half, 0, 0.12), oak, "Y")
        for x in places:
            build.box((x - 0.01, -0.09, 0.03), (x + 0.01, -0.02, 0.05), metal, "Y")
    for k, x in enumerate(places):
        if rng.random() < 0.3:
            continue
        cloth = build.material(_coat(rng), None)
        with build.object(f"coat {k}"), build.frame((x, -0.09, 0)):
            long, wide = rng.uniform(0.65, 1.0), rng.uniform(0.09, 0.12)
            build.pillow((-wide, -0.07, -long), (wide, 0.06, 0.03), cloth, 0.45)


def _coat(rng: Rng) -> Image:
    return fabric.weave(rng, hsv(rng.random(), rng.uniform(0.1, 0.7), rng.uniform(0.2, 0.6)))


def toy_box(build: MeshBuilder, rng: Rng, name: str = "toy box") -> None:
    """Open chest full of blocks and balls, 0.6 x 0.4 m, its back at y = 0."""
    oak = wood(build, rng, (0.5, 0.5), 256)
    with build.object(name):
        build.box((-0.3, -0.4, 0), (0.3, 0, 0.32), oak, "zZ")
        build.quad((-0.28, -0.38, 0.22), (0.56, 0, 0), (0, 0.36, 0), oak)
        build.box((-0.28, -0.02, 0.22), (0.28, -0.018, 0.32), oak, "YzZ")
    for k in range(7):
        with build.frame((rng.uniform(-0.2, 0.2), rng.uniform(-0.3, -0.1), 0.2)):
            toy(build, rng, f"{name} toy {k}")


def toy(build: MeshBuilder, rng: Rng, name: str) -> None:
    """A block with a letter or picture, or a ball, at the origin."""
    size = rng.uniform(0.06, 0.13)
    bright = hsv(rng.random(), rng.uniform(0.6, 0.9), rng.uniform(0.6, 0.9))
    with build.object(name), build.frame((0, 0, 0), yaw=rng.uniform(-np.pi, np.pi)):
        if rng.random() < 0.5:
            side = build.material(pictures.cover(rng, 96, 96))
            build.box((-size / 2, -size / 2, 0), (size / 2, size / 2, size), side, "z")
        else:
            skin = build.material(grain(rng, bright, (64, 64), (0.09, 1.2)), (0.1, 0.1))
            build.pillow((-size / 2, -size / 2, 0), (size / 2, size / 2, size), skin, 1.0)
