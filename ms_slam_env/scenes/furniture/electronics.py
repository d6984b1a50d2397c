"""Screens, laptop, keyboard."""

from __future__ import annotations

import cv2
import numpy as np

from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.textures import printed
from ms_slam_env.scenes.textures.noise import Image


def television(build: MeshBuilder, rng: np.random.Generator, width_m: float) -> None:
    """Flat television on a foot; its picture has the label "TV screen"."""
    black = build.plain((24, 24, 26))
    h, half = 0.57 * width_m, width_m / 2
    with build.object("TV"):
        build.box((-0.25, -0.28, 0), (0.25, -0.06, 0.015), black, "z")
        build.box((-0.05, -0.18, 0.015), (0.05, -0.14, 0.08), black)
        build.box((-half, -0.19, 0.07), (half, -0.14, 0.07 + h), black)
    with build.object("TV screen"):
        film = build.material(printed.television(rng))
        build.quad((-half + 0.015, -0.192, 0.09), (width_m - 0.03, 0, 0), (0, 0, h - 0.04), film)


def monitor(build: MeshBuilder, rng: np.random.Generator, width_m: float, name: str) -> None:
    """Computer monitor on a foot; its picture has the label "<name> screen"."""
    black = build.plain((30, 30, 33))
    h, half = 0.58 * width_m, width_m / 2
    with build.object(name):
        build.lathe(
            [(0.11, 0), (0.11, 0.012), (0.11, 0.012), (0.02, 0.016), (0.02, 0.12)],
            black,
            18,
            (0, -0.1, 0),
        )
        build.box((-half, -0.13, 0.1), (half, -0.1, 0.1 + h), black)
    with build.object(f"{name} screen"):
        desktop = build.material(printed.screen(rng))
        build.quad((-half + 0.01, -0.132, 0.11), (width_m - 0.02, 0, 0), (0, 0, h - 0.02), desktop)


def keys(rng: np.random.Generator) -> Image:
    """Seen from above: rows of keys with a letter each."""
    image = np.full((128, 320, 3), 38, np.uint8)
    for row in range(5):
        x = 6 + 6 * row % 15
        while x < 300:
            wide = 20 if rng.random() < 0.85 else 40
            cv2.rectangle(
                image, (x, 6 + 24 * row), (min(x + wide - 4, 312), 25 + 24 * row), (72, 72, 76), -1
            )
            cv2.circle(image, (x + 6, 14 + 24 * row), 2, (225, 225, 225), -1)
            x += wide
    return image


def keyboard(build: MeshBuilder, rng: np.random.Generator, name: str) -> None:
    """Keyboard of 42 x 14 cm."""
    with build.object(name):
        side = build.plain((36, 36, 38))
        top = build.material(keys(rng))
        build.box((-0.21, -0.14, 0), (0.21, 0, 0.018), side, "z", top=top)


def laptop(build: MeshBuilder, rng: np.random.Generator, name: str) -> None:
    """Open laptop; its picture has the label "<name> screen"."""
    silver = build.plain((150, 152, 156))
    with build.object(name):
        build.box((-0.165, -0.23, 0), (0.165, 0, 0.016), silver, "z")
        build.quad((-0.15, -0.16, 0.0165), (0.3, 0, 0), (0, 0.14, 0), build.material(keys(rng)))
        build.quad(
            (-0.045, -0.22, 0.0165), (0.09, 0, 0), (0, 0.05, 0), build.plain((120, 122, 126))
        )
    with build.frame((0, 0, 0.012), pitch=-0.3):
        with build.object(name):
            build.box((-0.165, -0.004, 0), (0.165, 0.004, 0.225), silver)
        with build.object(f"{name} screen"):
            desktop = build.material(printed.screen(rng))
            build.quad((-0.155, -0.0045, 0.012), (0.31, 0, 0), (0, 0, 0.2), desktop)
