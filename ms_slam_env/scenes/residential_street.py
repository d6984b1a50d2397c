"""A residential quarter: two by two blocks of houses with gardens, streets all around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder, pick
from ms_slam_env.scenes.mesh_scene import LargeScene
from ms_slam_env.scenes.outdoors import houses, street_furniture
from ms_slam_env.scenes.outdoors.daylight import daylight_scene
from ms_slam_env.scenes.outdoors.plan import KERB_M, Plot, StreetPlan, sides_of
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior, outdoor

_CELL_M = 0.45
_PLACES = (("SW", "S", "SE"), ("W", "C", "E"), ("NW", "N", "NE"))
_NAMES = ("ELM ST", "OAK AVE", "PARK RD", "MILL LN", "HILL ST", "LAKE RD")


@dataclass(frozen=True)
class _Kinds:
    """Shared materials and kinds of objects in the quarter."""

    houses: houses.Finishes
    leaves: tuple[Material, ...]
    boards: tuple[Material, ...]
    bark: Material


def residential_street(seed: int) -> LargeScene:
    """Build the quarter of ``seed``.

    Blocks of 18 to 19.5 by 16 to 17 m from one street to the next, smaller than real ones so that
    routes around them are short. Places: the nine crossings, "SW" to "NE", with "C" between.
    """
    rng = np.random.default_rng([seed, 11])
    dx, dy = rng.uniform(18.0, 19.5, 2), rng.uniform(16.0, 17.0, 2)
    plan = StreetPlan(
        xs=(0.0, float(dx[0]), float(dx.sum())),
        ys=(0.0, float(dy[0]), float(dy.sum())),
        road_m=5.2,
        pavement_m=1.1,
        margin_m=9.0,
    )
    build = MeshBuilder(_CELL_M)
    _ground(build, rng, plan)
    of = _Kinds(
        houses.finishes(build, rng),
        tuple(street_furniture.foliage(build, rng) for _ in range(3)),
        tuple(street_furniture.fence_boards(build, rng) for _ in range(4)),
        build.material(outdoor.bark(rng), (0.5, 0.5)),
    )
    for k, plot in enumerate(plan.blocks()):
        _block(build, rng, plot, k, of)
    for k, plot in enumerate(plan.surroundings()):
        _row_of_houses(build, rng, plot, k, of)
    _kerbside(build, rng, plan, of)
    places = plan.crossings(_PLACES)
    return daylight_scene(residential_street, seed, build, rng, plan, places, _ways())


def _ways() -> tuple[tuple[str, str], ...]:
    rows = [(names[k], names[k + 1]) for names in _PLACES for k in range(2)]
    columns = [(_PLACES[k][c], _PLACES[k + 1][c]) for c in range(3) for k in range(2)]
    return (*rows, *columns)


def _ground(build: MeshBuilder, rng: Rng, plan: StreetPlan) -> None:
    road = build.material(outdoor.asphalt(rng), (6.4, 6.4))
    pavement = build.material(outdoor.paving(rng), (2.2, 2.2))
    kerb = build.material(interior.plaster(rng, (168, 164, 156), 4.0, 256), (0.9, 0.9))
    lawn = build.material(outdoor.grass(rng), (3.0, 3.0))
    plan.ground(build, road, pavement, kerb, lawn)


def _block(build: MeshBuilder, rng: Rng, plot: Plot, index: int, of: _Kinds) -> None:
    """One house in its garden, hedges and fences along the pavements, trees and bushes."""
    w, d = plot.width_m, plot.depth_m
    with build.frame(plot.origin, plot.yaw):
        wide, deep = rng.uniform(6.0, 7.0), rng.uniform(4.4, 5.0)
        x, y = rng.uniform(1.6, w - wide - 1.6), rng.uniform(1.7, d - deep - 1.4)
        turned = bool(rng.random() < 0.5)
        at, yaw = ((x, y, 0.0), 0.0) if not turned else ((x + wide, y + deep, 0.0), np.pi)
        with build.frame(at, yaw):
            houses.house(
                build, rng, of.houses, wide, deep, f"house {index}", int(rng.integers(1, 3))
            )
        for k, (origin, turn, length) in enumerate(sides_of(w, d)):
            with build.frame(origin, turn):
                _garden_edge(build, rng, length, f"{index}.{k}", of)
        for k, (cx, cy) in enumerate(
            ((1.3, 1.3), (w - 1.3, 1.4), (1.4, d - 1.3), (w - 1.3, d - 1.3))
        ):
            taken = x - 1.0 < cx < x + wide + 1.0 and y - 1.0 < cy < y + deep + 1.0
            if not taken and rng.random() < 0.75:
                with build.frame((cx, cy, 0.0), rng.uniform(0, 6)):
                    tree_height = rng.uniform(3.6, 5.2)
                    kind = pick(rng, of.leaves)
                    street_furniture.tree(
                        build, rng, of.bark, kind, tree_height, f"garden tree {index}.{k}"
                    )


def _garden_edge(build: MeshBuilder, rng: Rng, length: float, name: str, of: _Kinds) -> None:
    """Hedge, fence, or bushes along a plot's edge, with a gap for a gate."""
    gap = length * rng.uniform(0.35, 0.6)
    for k, (low, high) in enumerate(((0.6, gap - 0.7), (gap + 0.7, length - 0.6))):
        if high - low < 0.8:
            continue
        kind = rng.random()
        with build.frame((low, 0.12, 0.0)):
            if kind < 0.42:
                leaf = pick(rng, of.leaves)
                street_furniture.hedge(
                    build, leaf, high - low, rng.uniform(0.8, 1.25), f"hedge {name}.{k}"
                )
            elif kind < 0.78:
                boards, tall = pick(rng, of.boards), rng.uniform(0.8, 1.3)
                street_furniture.fence(build, boards, high - low, tall, f"fence {name}.{k}")
            else:
                for n, at in enumerate(np.arange(0.4, high - low - 0.2, 1.1)):
                    with build.frame((at, 0.35, 0.0), rng.uniform(0, 6)):
                        leaf, size = pick(rng, of.leaves), rng.uniform(0.35, 0.6)
                        street_furniture.bush(build, rng, leaf, size, f"bush {name}.{k}.{n}")


def _row_of_houses(build: MeshBuilder, rng: Rng, plot: Plot, index: int, of: _Kinds) -> None:
    """Houses side by side along an outer street, gardens in front, a tall hedge behind."""
    with build.frame(plot.origin, plot.yaw):
        x, number = 0.3, 0
        while True:
            wide, deep = rng.uniform(5.6, 8.0), rng.uniform(4.8, 5.6)
            if x + wide > plot.width_m - 0.3:
                break
            name = f"row {index} house {number}"
            with build.frame((x, rng.uniform(1.8, 2.8), 0.0)):
                houses.house(build, rng, of.houses, wide, deep, name, int(rng.integers(1, 3)))
            with build.frame((x, 0.0, 0.0)):
                _garden_edge(build, rng, wide, f"row {index}.{number}", of)
            gap = rng.uniform(1.4, 2.6)
            if rng.random() < 0.6:
                with build.frame((x + wide + gap / 2, rng.uniform(0.8, 2.0), 0.0)):
                    kind = pick(rng, of.leaves)
                    high = rng.uniform(3.6, 5.5)
                    street_furniture.tree(
                        build, rng, of.bark, kind, high, f"row {index} tree {number}"
                    )
            x += wide + gap
            number += 1
        with build.frame((0.0, plot.depth_m - 0.6, 0.0)):
            street_furniture.hedge(
                build, of.leaves[index % 3], plot.width_m, 2.6, f"tall hedge {index}"
            )


def _kerbside(build: MeshBuilder, rng: Rng, plan: StreetPlan, of: _Kinds) -> None:
    """Parked cars at the kerb, lamp posts, street trees, bins and signs on the pavements."""
    for k, (middle, yaw, length) in enumerate(plan.kerbsides()):
        with build.frame(middle, yaw):
            at = rng.uniform(-0.28, 0.28) * length
            if k % 4 < 2 and rng.random() < 0.85:
                with build.frame((at, -plan.pavement_m - 0.98, -KERB_M)):
                    street_furniture.car(build, rng, f"car {k}")
            with build.frame((-0.32 * length, -0.85 * plan.pavement_m, 0.0)):
                street_furniture.lamp_post(build, rng.uniform(3.6, 4.4), f"lamp post {k}")
            with build.frame((0.36 * length, -0.8 * plan.pavement_m, 0.0)):
                kind, high = pick(rng, of.leaves), rng.uniform(3.4, 4.4)
                if rng.random() < 0.7:
                    street_furniture.tree(build, rng, of.bark, kind, high, f"street tree {k}")
            with build.frame((rng.uniform(-0.2, 0.2) * length, -0.32, 0.0), rng.uniform(-0.3, 0.3)):
                street_furniture.bin_(build, rng, f"bin {k}")
            with build.frame((0.47 * length, -0.25, 0.0)):
                text = _NAMES[int(rng.integers(len(_NAMES)))]
                street_furniture.sign(build, rng, text, f"sign {k}")
