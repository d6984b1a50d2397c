"""Street furniture: lamp posts, cars, signs, bins, benches, crossings; trees, hedges, fences."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior, outdoor
from ms_slam_env.scenes.textures.noise import grain, hsv


def lamp_post(build: MeshBuilder, height_m: float, name: str) -> None:
    """Post at the origin with an arm and a head towards -y."""
    metal = build.plain((72, 78, 76))
    glass = build.plain((236, 236, 226))
    with build.object(name):
        build.lathe([(0.11, 0), (0.11, 0.7), (0.07, 0.75), (0.05, height_m)], metal, 10)
        build.box((-0.04, -0.9, height_m - 0.06), (0.04, 0.05, height_m + 0.02), metal)
        build.box((-0.13, -1.3, height_m - 0.1), (0.13, -0.8, height_m + 0.04), metal, "z")
        build.box((-0.11, -1.28, height_m - 0.14), (0.11, -0.82, height_m - 0.1), glass, "Z")


def car(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Parked car at the origin, 4.1 m long, front at +x."""
    hue, strength = rng.choice([0.0, 0.03, 0.12, 0.38, 0.58, 0.62]), rng.choice([0.04, 0.1, 0.65])
    colour = hsv(hue, strength, rng.uniform(0.3, 0.9))
    paint = build.material(grain(rng, colour, (128, 128), (0.03, 1.2), (0.02, 0.3)), (1.5, 1.5))
    glass = build.plain((38, 46, 54))
    colours = ((24, 24, 26), (240, 240, 230), (180, 24, 20))
    dark, light, red = (build.plain(rgb) for rgb in colours)
    plate = build.material(outdoor.road_sign(rng, f"MS {rng.integers(100, 999)}", (240, 238, 230)))
    upper: Float64 = np.array(
        [(-2.05, 0.72), (-1.9, 0.92), (0.75, 0.94), (1.5, 0.86), (1.95, 0.72), (2.05, 0.55)]
    )
    lower = np.column_stack([np.linspace(-2.05, 2.05, 6), np.full(6, 0.27)])
    roof: Float64 = np.array([(-1.75, 0.92), (-1.15, 1.42), (0.05, 1.45), (0.8, 0.94)])
    base = np.column_stack([np.linspace(-1.75, 0.8, 4), np.full(4, 0.92)])
    with build.object(name):
        _prism(build, lower, upper, 0.86, paint, paint)
        _prism(build, base, roof, 0.74, glass, glass)
        build.box((-1.12, -0.72, 1.41), (0.05, 0.72, 1.47), paint, "z")
        for x in (-0.6, -1.2, 0.15):  # pillars
            build.box((x - 0.04, -0.755, 0.92), (x + 0.04, 0.755, 1.38), paint, "zZ")
        for y in (-0.66, 0.42):
            build.box((1.98, y, 0.52), (2.08, y + 0.26, 0.66), light)
            build.box((-2.09, y, 0.6), (-2.03, y + 0.26, 0.75), red)
        build.box((-2.08, -0.25, 0.38), (2.09, 0.25, 0.52), dark, "zZ")
        with build.frame((2.1, 0.0, 0.38), np.pi / 2):
            build.quad((-0.25, 0, 0), (0.5, 0, 0), (0, 0, 0.12), plate)
        for x in (-1.25, 1.3):
            for y, pitch in ((-0.87, np.pi / 2), (0.87, -np.pi / 2)):
                _wheel(build, (x, y, 0.31), pitch, dark)


def _prism(
    build: MeshBuilder, lower: Float64, upper: Float64, half: float, side: Material, top: Material
) -> None:
    """Body between two chains (n, 2) of (x, z), from y = -half to half."""
    for y, order in ((-half, 1), (half, -1)):
        chain = np.stack([lower, upper])[:, ::order]  # (2, n, 2)
        build.patch(np.insert(chain, 1, y, axis=2), side)
    strip = np.stack([np.insert(upper, 1, -half, axis=1), np.insert(upper, 1, half, axis=1)])
    build.patch(strip, top)
    for k, order in ((0, -1), (-1, 1)):
        ends = [np.insert(chain[k], 1, y) for chain in (lower, upper) for y in (-half, half)]
        build.patch(np.array(ends).reshape(2, 2, 3)[:, ::order], side)


def _wheel(build: MeshBuilder, centre: ArrayLike, pitch: float, tyre: Material) -> None:
    hub = build.plain((150, 152, 156))
    with build.frame(centre, 0.0, pitch):
        build.lathe([(0.31, -0.16), (0.31, 0.0), (0.3, 0.02), (0.2, 0.02)], tyre, 14)
        build.lathe([(0.2, 0.02), (0.0, 0.03)], hub, 14)


def sign(build: MeshBuilder, rng: Rng, text: str, name: str) -> None:
    """Street sign on a pole, readable from -y and from +y."""
    metal = build.plain((120, 122, 124))
    colour = hsv(rng.choice([0.0, 0.33, 0.62]), 0.75, rng.uniform(0.35, 0.6))
    board = build.material(outdoor.road_sign(rng, text, colour))
    with build.object(name):
        build.lathe([(0.035, 0), (0.035, 2.5)], metal, 8)
        build.box((-0.45, -0.05, 2.0), (0.45, -0.03, 2.45), metal, front=board)
        with build.frame((0, 0, 0), np.pi):
            build.quad((-0.45, 0.02, 2.0), (0.9, 0, 0), (0, 0, 0.45), board)


def bin_(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Wheeled refuse bin at the origin."""
    colour = hsv(rng.choice([0.1, 0.33, 0.6]), rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.5))
    plastic = build.material(interior.plaster(rng, colour, 3.0, 64), (0.6, 0.6))
    with build.object(name):
        build.box((-0.28, -0.3, 0.06), (0.28, 0.3, 1.0), plastic, "z")
        build.box((-0.31, -0.34, 1.0), (0.31, 0.33, 1.08), plastic)
        build.box((-0.14, -0.305, 0.4), (0.14, -0.3, 0.7), build.plain((225, 222, 214)), "Y")


def bench(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Slatted bench, seat towards -y."""
    wood = build.material(outdoor.boards(rng, (150, 104, 66), 6), (0.5, 0.5))
    metal = build.plain((48, 50, 52))
    with build.object(name):
        for k in range(4):
            build.box((-0.8, -0.45 + 0.11 * k, 0.42), (0.8, -0.36 + 0.11 * k, 0.46), wood)
        for k in range(3):
            build.box((-0.8, 0.0, 0.55 + 0.12 * k), (0.8, 0.03, 0.64 + 0.12 * k), wood)
        for x in (-0.7, 0.66):
            build.box((x, -0.45, 0), (x + 0.04, 0.03, 0.42), metal, "z")
            build.box((x, 0.03, 0), (x + 0.04, 0.06, 0.9), metal, "z")


def stripes(
    build: MeshBuilder,
    low: tuple[float, float],
    high: tuple[float, float],
    along_x: bool,
    name: str,
) -> None:
    """Zebra crossing on the carriageway; bars lie along x, or along y."""
    paint = build.plain((214, 212, 204))
    axis = 1 if along_x else 0
    with build.object(name):
        for start in np.arange(low[axis] + 0.2, high[axis] - 0.4, 0.9):
            a = [*low, 0.005]
            size = [high[0] - low[0], high[1] - low[1]]
            a[axis], size[axis] = start, 0.45
            build.quad(a, (size[0], 0, 0), (0, size[1], 0), paint)


def foliage(build: MeshBuilder, rng: Rng) -> Material:
    """Leaves of one kind of plant."""
    return build.material(outdoor.clump(rng, rng.uniform(0.2, 0.31)), (0.9, 0.9))


def fence_boards(build: MeshBuilder, rng: Rng) -> Material:
    """Painted or grey boards of a fence."""
    tone = hsv(0.08, rng.uniform(0.05, 0.5), rng.uniform(0.5, 0.85))
    return build.material(outdoor.boards(rng, tone), (1.3, 1.0))


def lump(
    build: MeshBuilder,
    rng: Rng,
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
        np.broadcast_arrays(longitude / (2 * np.pi) * round_, -latitude * size[2] / tile[1]), -1
    )
    build.patch(grid, material, uv, inset=False)


def tree(
    build: MeshBuilder, rng: Rng, bark: Material, leaves: Material, height_m: float, name: str
) -> None:
    """Trunk with a crown of lumps, standing at the origin."""
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


def bush(build: MeshBuilder, rng: Rng, leaves: Material, radius_m: float, name: str) -> None:
    """Round bush at the origin."""
    with build.object(name):
        size = (radius_m, radius_m, 0.85 * radius_m)
        lump(build, rng, (0, 0, 0.6 * radius_m), size, leaves, 0.3)


def hedge(
    build: MeshBuilder, leaves: Material, length_m: float, height_m: float, name: str
) -> None:
    """Trimmed hedge along x from the origin, 0.5 m thick."""
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
