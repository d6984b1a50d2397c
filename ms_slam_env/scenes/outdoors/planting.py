"""Trees, hedges and fences."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.textures import street
from ms_slam_env.scenes.textures.noise import hsv


def foliage(build: MeshBuilder, rng: np.random.Generator) -> Material:
    """Leaves of one kind of plant."""
    return build.material(street.clump(rng, rng.uniform(0.2, 0.31)), (0.9, 0.9))


def fence_boards(build: MeshBuilder, rng: np.random.Generator) -> Material:
    """Painted or grey boards of a fence."""
    tone = hsv(0.08, rng.uniform(0.05, 0.5), rng.uniform(0.5, 0.85))
    return build.material(street.boards(rng, tone), (1.3, 1.0))


def lump(
    build: MeshBuilder,
    rng: np.random.Generator,
    centre: ArrayLike,
    radii: ArrayLike,
    material: Material,
    roughness: float = 0.2,
) -> None:
    """Add an ellipsoid with bumps: the crown of a tree, or a bush."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 9)[:, None]
    longitude = np.linspace(0, 2 * np.pi, 14)[None, :]
    bumps = np.ones((9, 14))
    for _ in range(5):
        a, b = rng.integers(1, 4, 2)
        phase = rng.uniform(0, 2 * np.pi, 2)
        wave = np.sin(a * longitude + phase[0]) * np.sin(2 * b * latitude + phase[1])
        bumps += roughness / 2 * wave * np.cos(latitude)
    unit = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude) * np.ones_like(longitude),
        ],
        -1,
    )
    size = np.asarray(radii, dtype=np.float64)
    grid = np.asarray(centre, dtype=np.float64) + unit * bumps[..., None] * size
    tile = material.tile_m or (1.0, 1.0)
    round_ = max(1, round(2 * np.pi * size[:2].mean() / tile[0]))
    uv = np.stack(
        np.broadcast_arrays(longitude / (2 * np.pi) * round_, -latitude * size[2] / tile[1]),
        -1,
    )
    build.patch(grid, material, uv, inset=False)


def tree(
    build: MeshBuilder,
    rng: np.random.Generator,
    bark: Material,
    leaves: Material,
    height_m: float,
    name: str,
) -> None:
    """Trunk with a crown of lumps, standing on the origin."""
    trunk = 0.42 * height_m
    r = 0.035 * height_m
    lean = rng.uniform(-0.1, 0.1, 2)
    with build.object(f"{name} trunk"):
        build.lathe([(1.5 * r, 0), (r, 0.15 * trunk), (0.8 * r, 1.4 * trunk)], bark, 9)
    with build.object(name):
        wide = 0.23 * height_m
        build_at = [(lean[0], lean[1], 0.68 * height_m, wide, 0.26 * height_m)]
        for k in range(3):
            angle = 2.1 * k + rng.uniform(0, 1.0)
            out = 0.55 * wide
            z = rng.uniform(0.52, 0.68) * height_m
            build_at.append((out * np.cos(angle), out * np.sin(angle), z, 0.72 * wide, 0.6 * wide))
        for x, y, z, radius, high in build_at:
            lump(build, rng, (x, y, z), (radius, radius, high), leaves)


def bush(
    build: MeshBuilder, rng: np.random.Generator, leaves: Material, radius_m: float, name: str
) -> None:
    """Round bush on the origin."""
    with build.object(name):
        size = (radius_m, radius_m, 0.85 * radius_m)
        lump(build, rng, (0, 0, 0.6 * radius_m), size, leaves, 0.3)


def hedge(
    build: MeshBuilder, leaves: Material, length_m: float, height_m: float, name: str
) -> None:
    """Cut hedge along x from the origin, 0.5 m thick."""
    with build.object(name):
        build.box((0, 0, 0), (length_m, 0.5, height_m), leaves, "z")


def fence(
    build: MeshBuilder, boards: Material, length_m: float, height_m: float, name: str
) -> None:
    """Fence of boards along x from the origin, with posts."""
    wood = Material(boards.texture, (1.3, height_m))
    with build.object(name):
        build.box((0, 0, 0.05), (length_m, 0.03, height_m), wood, "z")
        for x in np.arange(0.0, length_m + 0.01, 1.8):
            build.box((x - 0.05, -0.05, 0), (x + 0.05, 0.08, height_m + 0.1), wood, "z")
