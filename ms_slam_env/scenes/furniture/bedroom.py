"""Beds, wardrobes, bedside lamps, coats, toys."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.base import Rng
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.furniture.small_things import wood
from ms_slam_env.scenes.textures import fabric, pictures
from ms_slam_env.scenes.textures.noise import Image, grain, hsv

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
