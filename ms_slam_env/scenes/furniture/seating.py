"""Sofa, armchair and chair."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.textures import fabric, wood
from ms_slam_env.scenes.textures.noise import hsv


def upholstery(build: MeshBuilder, rng: np.random.Generator) -> Material:
    """Woven fabric of a quiet colour."""
    colour = hsv(rng.random(), rng.uniform(0.08, 0.55), rng.uniform(0.3, 0.75))
    return build.material(fabric.weave(rng, colour), (0.25, 0.25))


def throw_pillow(build: MeshBuilder, rng: np.random.Generator, name: str) -> None:
    """Patterned pillow of 40 cm leaning back, standing on its lower edge."""
    hue = rng.random()
    colours = np.array([hsv(hue, 0.25, 0.85), hsv(hue + 0.05, 0.7, 0.5), hsv(hue + 0.5, 0.5, 0.4)])
    cloth = build.material(fabric.pattern(rng, colours), None)
    with build.object(name), build.frame((0, -0.1, 0.0), pitch=-0.35):
        build.pillow((-0.21, -0.08, 0.0), (0.21, 0.08, 0.4), cloth, 0.55)


def sofa(
    build: MeshBuilder, rng: np.random.Generator, width_m: float, seats: int, name: str = "sofa"
) -> None:
    """Upholstered seat with arms, back, loose cushions and a few throw pillows."""
    cloth = upholstery(build, rng)
    leg = build.material(wood.board(rng, size=256), (0.4, 0.4))
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


def chair(build: MeshBuilder, rng: np.random.Generator, name: str = "chair") -> None:
    """Wooden chair with a padded seat; stands on its four legs, back at y = 0."""
    frame_wood = build.material(wood.board(rng, size=256), (0.5, 0.5))
    pad = upholstery(build, rng)
    with build.object(name):
        for x in (-0.21, 0.17):
            build.box((x, -0.44, 0), (x + 0.04, -0.4, 0.44), frame_wood, "zZ")
            build.box((x, -0.04, 0), (x + 0.04, 0, 0.9), frame_wood, "z")
        build.box((-0.22, -0.45, 0.41), (0.22, 0, 0.45), frame_wood)
        build.pillow((-0.21, -0.45, 0.44), (0.21, -0.03, 0.5), pad, 0.35)
        for z in (0.56, 0.68, 0.8):
            build.box((-0.17, -0.03, z), (0.17, -0.01, z + 0.07), frame_wood)
