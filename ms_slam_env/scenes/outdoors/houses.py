"""Detached houses with gables, and terraces of town houses with shops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import Material, MeshBuilder, pick
from ms_slam_env.scenes.outdoors.plan import sides_of
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import fabric, interior, outdoor
from ms_slam_env.scenes.textures.noise import hsv
from ms_slam_env.scenes.textures.pictures import picture

STOREY_M = 2.7
SHOP_M = 3.6
TOWN_STOREY_M = 3.1


@dataclass(frozen=True)
class Finishes:
    """Materials of a quarter's houses; each house draws from these."""

    walls: tuple[Material, ...]
    roofs: tuple[Material, ...]
    panes: tuple[Material, ...]
    doors: tuple[Material, ...]
    trims: tuple[Material, ...]
    chimney: Material
    plinth: Material
    step: Material


def finishes(build: MeshBuilder, rng: Rng) -> Finishes:
    """Draw the finishes of a quarter."""
    tones = [
        hsv(rng.choice([0.02, 0.04, 0.6]), rng.uniform(0.1, 0.6), rng.uniform(0.34, 0.6))
        for _ in range(4)
    ]
    frames = (232, 230, 224)
    paints = [hsv(rng.random(), rng.uniform(0.4, 0.8), rng.uniform(0.25, 0.6)) for _ in range(5)]
    return Finishes(
        walls=tuple(wall_finish(build, rng) for _ in range(8)),
        roofs=tuple(build.material(outdoor.roof_tiles(rng, tone), (3.0, 3.0)) for tone in tones),
        panes=tuple(
            build.material(outdoor.pane(rng, frames, int(rng.integers(1, 3)))) for _ in range(10)
        ),
        doors=tuple(build.material(outdoor.panelled_door(rng, paint)) for paint in paints),
        trims=tuple(build.plain(hsv(0.1, 0.05, value)) for value in (0.78, 0.88, 0.95)),
        chimney=build.material(interior.brick(rng, hsv(0.03, 0.5, 0.5)), (0.8, 0.64)),
        plinth=build.material(interior.plaster(rng, (120, 116, 110), 4.0), (1.5, 1.5)),
        step=build.material(outdoor.paving(rng, 2, 256), (1.0, 1.0)),
    )


def wall_finish(build: MeshBuilder, rng: Rng) -> Material:
    """Render, brick or painted boards."""
    kind = rng.random()
    if kind < 0.4:
        hue, value = rng.choice([0.02, 0.04, 0.08]), rng.uniform(0.5, 0.72)
        return build.material(interior.brick(rng, hsv(hue, 0.5, value)), (0.8, 0.64))
    colour = hsv(
        rng.choice([0.08, 0.12, 0.15, 0.35, 0.57]), rng.uniform(0.06, 0.34), rng.uniform(0.68, 0.92)
    )
    if kind < 0.7:
        return build.material(outdoor.siding(rng, colour), (2.4, 1.4))
    return build.material(interior.plaster(rng, colour, 3.0), (2.0, 2.0))


def window(
    build: MeshBuilder,
    image: Material,
    frame: Material,
    at: tuple[float, float],
    size: tuple[float, float],
    has_sill: bool = True,
) -> None:
    """Window on the wall at y = 0, front at -y; ``at`` is its centre (x, z)."""
    (x, z), (w, h) = at, (size[0] / 2, size[1] / 2)
    build.box((x - w, -0.06, z - h), (x + w, 0, z + h), frame, "Y", front=image)
    if has_sill:
        low = z - h
        build.box((x - w - 0.1, -0.16, low - 0.08), (x + w + 0.1, 0, low), frame, "Y")


def house(
    build: MeshBuilder,
    rng: Rng,
    of: Finishes,
    width_m: float,
    depth_m: float,
    name: str,
    storeys: int = 2,
) -> None:
    """House with its front on y = 0 facing -y, from x = 0 to ``width_m``, and a gable roof."""
    wall, tiles = pick(rng, of.walls), pick(rng, of.roofs)
    trim, door = pick(rng, of.trims), pick(rng, of.doors)
    panes = [pick(rng, of.panes) for _ in range(3)]
    eaves = STOREY_M * storeys
    along_x = bool(rng.random() < 0.6)
    with build.object(name):
        build.box((0, 0, 0.4), (width_m, depth_m, eaves), wall, "zZ")
        build.box((-0.05, -0.05, 0), (width_m + 0.05, depth_m + 0.05, 0.4), of.plinth, "z")
        if along_x:
            _gable_roof(build, width_m, depth_m, eaves, tiles, wall)
        else:
            with build.frame((0, depth_m, 0), -np.pi / 2):
                _gable_roof(build, depth_m, width_m, eaves, tiles, wall)
        x = width_m * rng.uniform(0.25, 0.75)
        build.box(
            (x, 0.4 * depth_m, eaves), (x + 0.6, 0.4 * depth_m + 0.5, eaves + 2.6), of.chimney, "z"
        )
    door_at = width_m * rng.choice([0.25, 0.5, 0.75])
    with build.object(f"{name} windows"):
        for k, (origin, yaw, length) in enumerate(sides_of(width_m, depth_m)):
            count = max(1, int(length / 2.1))
            for storey in range(storeys):
                for n in range(count):
                    x = (n + 0.5) * length / count
                    if k == 0 and storey == 0 and abs(x - door_at) < 1.1:
                        continue
                    at = (x, STOREY_M * storey + 1.55)
                    size = (rng.uniform(0.95, 1.25), rng.uniform(1.15, 1.4))
                    with build.frame(origin, yaw):
                        window(build, pick(rng, panes), trim, at, size)
    with build.object(f"{name} door"):
        build.box((door_at - 0.5, -0.08, 0.3), (door_at + 0.5, 0, 2.4), trim, "Yz", front=door)
        build.box((door_at - 0.8, -0.9, 0), (door_at + 0.8, 0, 0.16), of.step, "zY")
        build.box((door_at - 0.7, -0.5, 0.16), (door_at + 0.7, 0, 0.3), of.step, "zY")
        build.box((door_at - 0.9, -0.9, 2.55), (door_at + 0.9, 0, 2.68), tiles, "Y")


def _gable_roof(
    build: MeshBuilder, width: float, depth: float, eaves: float, tiles: Material, wall: Material
) -> None:
    """Gable roof with its ridge along x over the middle, and 0.35 m of overhang."""
    over, rise = 0.35, 0.42 * depth
    slope: Float64 = np.array([0.0, depth / 2 + over, rise * (1 + 2 * over / depth)])
    low = eaves - rise * 2 * over / depth
    span = (width + 2 * over, 0, 0)
    build.quad((-over, -over, low), span, slope, tiles)
    back = slope * [1, -1, 1]
    build.quad((width + over, depth + over, low), (-span[0], 0, 0), back, tiles)
    # The undersides, so that the overhang is closed when seen from below.
    ridge = eaves + rise - 0.05
    build.quad((-over, depth / 2, ridge), span, -slope, wall)
    build.quad((width + over, depth / 2, ridge), (-span[0], 0, 0), -back, wall)
    t = np.linspace(0, 1, 7)
    for x, order in ((0.0, -1), (width, 1)):
        y = np.stack([depth / 2 * t, depth - depth / 2 * t], 1)[:, ::order]  # (7, 2)
        z = eaves + rise * t[:, None] * np.ones((1, 2))
        build.patch(np.stack([np.full_like(y, x), y, z], -1), wall)


_SIGNS = ("BAKERY", "CAFE", "BOOKS", "HOTEL", "SHOES", "BANK", "PIZZA", "PHOTO", "MUSIC", "TOYS")


@dataclass(frozen=True)
class TownFinishes:
    """Materials of a town's houses; each house draws from these."""

    walls: tuple[Material, ...]
    stones: tuple[Material, ...]
    panes: tuple[Material, ...]
    doors: tuple[Material, ...]
    displays: tuple[Material, ...]
    cloths: tuple[Material, ...]
    trims: tuple[Material, ...]
    signs: tuple[Material, ...]


def town_finishes(build: MeshBuilder, rng: Rng) -> TownFinishes:
    """Draw the finishes of a town."""
    walls = []
    for k in range(8):
        if k % 2:
            tone = hsv(rng.choice([0.02, 0.05, 0.09]), rng.uniform(0.25, 0.55), 0.62)
            walls.append(build.material(interior.brick(rng, tone), (0.9, 0.72)))
        else:
            tone = hsv(rng.choice([0.09, 0.12, 0.55]), rng.uniform(0.08, 0.3), 0.82)
            walls.append(build.material(interior.plaster(rng, tone, 3.5), (2.4, 2.4)))
    colours = [
        np.array([hsv(hue, 0.7, 0.6), hsv(hue, 0.05, 0.95), hsv(hue, 0.6, 0.4)])
        for hue in rng.random(4)
    ]
    return TownFinishes(
        walls=tuple(walls),
        stones=tuple(build.material(outdoor.paving(rng, 3, 256), (1.8, 1.8)) for _ in range(2)),
        panes=tuple(build.material(outdoor.pane(rng, (226, 224, 216), 1)) for _ in range(10)),
        doors=tuple(
            build.material(outdoor.panelled_door(rng, hsv(hue, 0.6, 0.35))) for hue in rng.random(4)
        ),
        displays=tuple(build.material(picture(rng, 256, 384)) for _ in range(10)),
        cloths=tuple(build.material(fabric.pattern(rng, c), (1.2, 1.2)) for c in colours),
        trims=tuple(build.plain(hsv(0.1, 0.06, value)) for value in (0.4, 0.7, 0.9)),
        signs=tuple(
            build.material(outdoor.road_sign(rng, text, hsv(rng.random(), 0.6, 0.35)))
            for text in _SIGNS
        ),
    )


def town_house(
    build: MeshBuilder,
    rng: Rng,
    of: TownFinishes,
    width_m: float,
    depth_m: float,
    storeys: int,
    name: str,
) -> None:
    """House with its front on y = 0 facing -y from x = 0; its sides and back are bare walls."""
    wall, stone, trim = pick(rng, of.walls), pick(rng, of.stones), pick(rng, of.trims)
    top = SHOP_M + TOWN_STOREY_M * storeys
    with build.object(name):
        build.box((0, 0, SHOP_M), (width_m, depth_m, top), wall, "z", top=stone)
        build.box((0, 0, 0), (width_m, depth_m, SHOP_M), stone, "zZ")
        build.box((-0.05, -0.22, SHOP_M - 0.15), (width_m + 0.05, 0, SHOP_M + 0.1), trim, "Y")
        build.box((-0.1, -0.4, top - 0.4), (width_m + 0.1, 0.0, top), trim, "Y")
        for x in (0.0, width_m - 0.35):
            build.box((x, -0.12, 0), (x + 0.35, 0, SHOP_M - 0.15), trim, "zY")
    panes = [pick(rng, of.panes) for _ in range(3)]
    count = max(2, int(width_m / 1.75))
    size = (rng.uniform(0.95, 1.15), rng.uniform(1.5, 1.85))
    with build.object(f"{name} windows"):
        for storey in range(storeys):
            for n in range(count):
                at = ((n + 0.5) * width_m / count, SHOP_M + TOWN_STOREY_M * storey + 1.6)
                window(build, pick(rng, panes), trim, at, size)
    _shop(build, rng, of, width_m, name, trim)


def _shop(
    build: MeshBuilder, rng: Rng, of: TownFinishes, width: float, name: str, trim: Material
) -> None:
    """Door, shop windows, perhaps an awning, a sign above."""
    door_at = rng.uniform(1.0, 1.4) if rng.random() < 0.5 else width - rng.uniform(1.0, 1.4)
    with build.object(f"{name} door"):
        door = pick(rng, of.doors)
        build.box((door_at - 0.55, -0.07, 0), (door_at + 0.55, 0, 2.5), trim, "Yz", front=door)
    low, high = (0.55, door_at - 0.8) if door_at > width / 2 else (door_at + 0.8, width - 0.55)
    count = max(1, round((high - low) / 2.2))
    each = (high - low) / count
    with build.object(f"{name} shop windows"):
        for k in range(count):
            x = low + k * each
            view = pick(rng, of.displays)
            build.box((x + 0.06, -0.08, 0.5), (x + each - 0.06, 0, 2.55), trim, "Y", front=view)
            build.box((x + 0.04, -0.16, 0.35), (x + each - 0.04, 0, 0.5), trim, "Y")
    with build.object(f"{name} sign"):
        middle = (low + high) / 2
        board = pick(rng, of.signs)
        build.box((middle - 1.1, -0.14, 2.75), (middle + 1.1, 0, 3.35), trim, "Y", front=board)
    if rng.random() < 0.5:
        cloth = pick(rng, of.cloths)
        with build.object(f"{name} awning"):
            xs = np.linspace(low, high, max(2, int((high - low) / 0.4)))
            out = np.array([1.1, 0.0])
            z = np.array([2.35, 2.72])
            grid = np.stack(np.broadcast_arrays(xs[None, :], -0.02 - out[:, None], z[:, None]), -1)
            build.sheet(grid, cloth, 0.02)
