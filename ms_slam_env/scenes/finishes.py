"""Finishes that all rooms share: floors, paint, wallpaper."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.base import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.textures import masonry, wood
from ms_slam_env.scenes.textures.noise import hsv


def floor_material(build: MeshBuilder, rng: np.random.Generator) -> Material:
    """Wooden planks, 2 x 1.2 m of them."""
    tone = wood.TONES[rng.integers(len(wood.TONES))]
    return build.material(wood.planks(rng, tone), (2.0, 1.2))


def wall_colour(rng: np.random.Generator) -> Float64:
    """Return a quiet light paint."""
    return hsv(
        rng.choice([0.09, 0.12, 0.16, 0.3, 0.55, 0.6]),
        rng.uniform(0.04, 0.22),
        rng.uniform(0.74, 0.92),
    )


def wall_material(
    build: MeshBuilder, rng: np.random.Generator, colour: Float64, papered: bool
) -> Material:
    """Plaster in ``colour``; if ``papered``, wallpaper or brick instead."""
    if not papered:
        return build.material(masonry.plaster(rng, colour), (2.0, 2.0))
    if rng.random() < 0.25:
        return build.material(masonry.brick(rng, hsv(0.03, 0.5, 0.62)), (0.75, 0.6))
    accent = np.clip(colour * rng.uniform(0.6, 0.85, 3), 0, 255)
    return build.material(masonry.wallpaper(rng, colour, accent), (0.9, 0.9))
