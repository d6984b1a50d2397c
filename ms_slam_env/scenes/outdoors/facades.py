"""Terraces of town houses: shops below, storeys of windows above, a cornice on top."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.outdoors.houses import window
from ms_slam_env.scenes.textures import fabric, masonry, street
from ms_slam_env.scenes.textures.noise import hsv
from ms_slam_env.scenes.textures.pictures import picture

SHOP_M = 3.6
STOREY_M = 3.1
_SIGNS = ("BAKERY", "CAFE", "BOOKS", "HOTEL", "SHOES", "BANK", "PIZZA", "PHOTO", "MUSIC", "TOYS")


@dataclass(frozen=True)
class TownFinishes:
    """What the houses of a town are made of; each house draws from these."""

    walls: tuple[Material, ...]
    stones: tuple[Material, ...]
    panes: tuple[Material, ...]
    doors: tuple[Material, ...]
    displays: tuple[Material, ...]
    cloths: tuple[Material, ...]
    trims: tuple[Material, ...]
    signs: tuple[Material, ...]


def town_finishes(build: MeshBuilder, rng: np.random.Generator) -> TownFinishes:
    """Draw the finishes of a town."""
    walls = []
    for k in range(8):
        if k % 2:
            tone = hsv(rng.choice([0.02, 0.05, 0.09]), rng.uniform(0.25, 0.55), 0.62)
            walls.append(build.material(masonry.brick(rng, tone), (0.9, 0.72)))
        else:
            tone = hsv(rng.choice([0.09, 0.12, 0.55]), rng.uniform(0.08, 0.3), 0.82)
            walls.append(build.material(masonry.plaster(rng, tone, 3.5), (2.4, 2.4)))
    colours = [
        np.array([hsv(hue, 0.7, 0.6), hsv(hue, 0.05, 0.95), hsv(hue, 0.6, 0.4)])
        for hue in rng.random(4)
    ]
    return TownFinishes(
        walls=tuple(walls),
        stones=tuple(build.material(street.paving(rng, 3, 256), (1.8, 1.8)) for _ in range(2)),
        panes=tuple(build.material(street.pane(rng, (226, 224, 216), 1)) for _ in range(10)),
        doors=tuple(
            build.material(street.panelled_door(rng, hsv(hue, 0.6, 0.35))) for hue in rng.random(4)
        ),
        displays=tuple(build.material(picture(rng, 256, 384)) for _ in range(10)),
        cloths=tuple(build.material(fabric.pattern(rng, c), (1.2, 1.2)) for c in colours),
        trims=tuple(build.plain(hsv(0.1, 0.06, value)) for value in (0.4, 0.7, 0.9)),
        signs=tuple(
            build.material(street.road_sign(rng, text, hsv(rng.random(), 0.6, 0.35)))
            for text in _SIGNS
        ),
    )


def town_house(
    build: MeshBuilder,
    rng: np.random.Generator,
    of: TownFinishes,
    width_m: float,
    depth_m: float,
    storeys: int,
    name: str,
) -> None:
    """House with its front on y = 0 facing -y from x = 0; its sides and back are bare walls."""
    wall, stone, trim = _pick(rng, of.walls), _pick(rng, of.stones), _pick(rng, of.trims)
    top = SHOP_M + STOREY_M * storeys
    with build.object(name):
        build.box((0, 0, SHOP_M), (width_m, depth_m, top), wall, "z", top=stone)
        build.box((0, 0, 0), (width_m, depth_m, SHOP_M), stone, "zZ")
        build.box((-0.05, -0.22, SHOP_M - 0.15), (width_m + 0.05, 0, SHOP_M + 0.1), trim, "Y")
        build.box((-0.1, -0.4, top - 0.4), (width_m + 0.1, 0.0, top), trim, "Y")
        for x in (0.0, width_m - 0.35):
            build.box((x, -0.12, 0), (x + 0.35, 0, SHOP_M - 0.15), trim, "zY")
    panes = [_pick(rng, of.panes) for _ in range(3)]
    count = max(2, int(width_m / 1.75))
    size = (rng.uniform(0.95, 1.15), rng.uniform(1.5, 1.85))
    with build.object(f"{name} windows"):
        for storey in range(storeys):
            for n in range(count):
                at = ((n + 0.5) * width_m / count, SHOP_M + STOREY_M * storey + 1.6)
                window(build, panes[int(rng.integers(3))], trim, at, size)
    _shop(build, rng, of, width_m, name, trim)


def _shop(
    build: MeshBuilder,
    rng: np.random.Generator,
    of: TownFinishes,
    width: float,
    name: str,
    trim: Material,
) -> None:
    """Door, shop windows, perhaps an awning, a sign above."""
    door_at = rng.uniform(1.0, 1.4) if rng.random() < 0.5 else width - rng.uniform(1.0, 1.4)
    with build.object(f"{name} door"):
        door = _pick(rng, of.doors)
        build.box((door_at - 0.55, -0.07, 0), (door_at + 0.55, 0, 2.5), trim, "Yz", front=door)
    low, high = (0.55, door_at - 0.8) if door_at > width / 2 else (door_at + 0.8, width - 0.55)
    count = max(1, round((high - low) / 2.2))
    each = (high - low) / count
    with build.object(f"{name} shop windows"):
        for k in range(count):
            x = low + k * each
            view = _pick(rng, of.displays)
            build.box((x + 0.06, -0.08, 0.5), (x + each - 0.06, 0, 2.55), trim, "Y", front=view)
            build.box((x + 0.04, -0.16, 0.35), (x + each - 0.04, 0, 0.5), trim, "Y")
    with build.object(f"{name} sign"):
        middle = (low + high) / 2
        board = _pick(rng, of.signs)
        build.box((middle - 1.1, -0.14, 2.75), (middle + 1.1, 0, 3.35), trim, "Y", front=board)
    if rng.random() < 0.5:
        cloth = _pick(rng, of.cloths)
        with build.object(f"{name} awning"):
            xs = np.linspace(low, high, max(2, int((high - low) / 0.4)))
            out = np.array([1.1, 0.0])
            z = np.array([2.35, 2.72])
            grid = np.stack(np.broadcast_arrays(xs[None, :], -0.02 - out[:, None], z[:, None]), -1)
            build.sheet(grid, cloth, 0.02)


def _pick(rng: np.random.Generator, materials: tuple[Material, ...]) -> Material:
    return materials[int(rng.integers(len(materials)))]
