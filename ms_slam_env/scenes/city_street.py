"""City streets: terraces of tall houses with shops, lanes and crossings, parked cars, trees."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.mesh_scene import LargeScene
from ms_slam_env.scenes.outdoors import houses, street_furniture
from ms_slam_env.scenes.outdoors.daylight import daylight_scene
from ms_slam_env.scenes.outdoors.plan import KERB_M, Plot, StreetPlan
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior, outdoor

_CELL_M = 0.55
_PLACES = (("SW", "S", "SE"), ("NW", "N", "NE"))
_WAYS = (("SW", "S"), ("S", "SE"), ("NW", "N"), ("N", "NE"), ("SW", "NW"), ("S", "N"), ("SE", "NE"))
_NAMES = ("MAIN ST", "MARKET", "STATION", "BRIDGE", "KING ST", "PORT RD")


def city_street(seed: int) -> LargeScene:
    """Build the streets of ``seed``: two blocks with streets around and between them.

    Places: the six crossings, "SW", "S", "SE" and "NW", "N", "NE".
    """
    rng = np.random.default_rng([seed, 12])
    dx, dy = rng.uniform(24.0, 27.0, 2), float(rng.uniform(26.0, 29.0))
    plan = StreetPlan(
        xs=(0.0, float(dx[0]), float(dx.sum())),
        ys=(0.0, dy),
        road_m=6.6,
        pavement_m=2.2,
        margin_m=7.5,
    )
    build = MeshBuilder(_CELL_M)
    road = build.material(outdoor.asphalt(rng), (6.4, 6.4))
    pavement = build.material(outdoor.paving(rng, 6), (3.0, 3.0))
    kerb = build.material(interior.plaster(rng, (150, 148, 142), 4.0, 256), (0.9, 0.9))
    yard = build.material(outdoor.paving(rng, 4, 256), (4.0, 4.0))
    plan.ground(build, road, pavement, kerb, yard)
    _markings(build, plan)
    of = houses.town_finishes(build, rng)
    for k, plot in enumerate(plan.blocks()):
        _block(build, rng, of, plot, k)
    for k, plot in enumerate(plan.surroundings()):
        with build.frame(plot.origin, plot.yaw):
            _terrace(build, rng, of, plot.width_m, plot.depth_m - 0.5, f"terrace {k}")
    _kerbside(build, rng, plan)
    places = plan.crossings(_PLACES)
    return daylight_scene(city_street, seed, build, rng, plan, places, _WAYS)


def _block(build: MeshBuilder, rng: Rng, of: houses.TownFinishes, plot: Plot, index: int) -> None:
    """Terraces back to back along the two long sides, end houses along the short ones."""
    w, d = plot.width_m, plot.depth_m
    deep = 0.32 * min(w, d)
    sides = (
        ((0, 0, 0), 0.0, w),
        ((w, deep, 0), np.pi / 2, d - 2 * deep),
        ((w, d, 0), np.pi, w),
        ((0, d - deep, 0), -np.pi / 2, d - 2 * deep),
    )
    with build.frame(plot.origin, plot.yaw):
        for k, (origin, yaw, length) in enumerate(sides):
            with build.frame(origin, yaw):
                _terrace(build, rng, of, length, deep, f"block {index}.{k}")


def _terrace(
    build: MeshBuilder, rng: Rng, of: houses.TownFinishes, length: float, depth: float, name: str
) -> None:
    """Houses wall to wall along x."""
    count = max(1, round(length / 7.0))
    shares = rng.uniform(0.8, 1.2, count)
    edges = np.concatenate([[0.0], np.cumsum(shares / shares.sum() * length)])
    for k in range(count):
        with build.frame((edges[k], rng.choice([0.0, 0.0, 0.3]), 0.0)):
            wide = edges[k + 1] - edges[k]
            storeys = int(rng.integers(2, 5))
            houses.town_house(build, rng, of, wide, depth, storeys, f"{name} house {k}")


def _markings(build: MeshBuilder, plan: StreetPlan) -> None:
    """Broken centre lines, and zebra crossings where streets meet."""
    paint = build.plain((212, 210, 202))
    h, r = plan.half_m, 0.5 * plan.road_m
    with build.object("centre lines"):
        for y in plan.ys:
            for x0, x1 in zip(plan.xs[:-1], plan.xs[1:], strict=True):
                for x in np.arange(x0 + h + 2.2, x1 - h - 3.0, 3.0):
                    build.quad((x, y - 0.07, 0.005), (1.4, 0, 0), (0, 0.14, 0), paint)
        for x in plan.xs:
            for y in np.arange(plan.ys[0] + h + 2.2, plan.ys[1] - h - 3.0, 3.0):
                build.quad((x - 0.07, y, 0.005), (0.14, 0, 0), (0, 1.4, 0), paint)
    for column, x in enumerate(plan.xs):
        for row, y in enumerate(plan.ys):
            name = f"crossing {column}.{row}"
            for side in (-1, 1):
                along = plan.xs[0] < x + side < plan.xs[-1]
                across = plan.ys[0] < y + side < plan.ys[-1]
                if along:
                    at = x + side * (r + 0.2) - (2.0 if side < 0 else 0.0)
                    street_furniture.stripes(build, (at, y - r), (at + 2.0, y + r), True, name)
                if across:
                    at = y + side * (r + 0.2) - (2.0 if side < 0 else 0.0)
                    street_furniture.stripes(build, (x - r, at), (x + r, at + 2.0), False, name)


def _kerbside(build: MeshBuilder, rng: Rng, plan: StreetPlan) -> None:
    """Parked cars on one side of each street; lamps, trees, signs, benches, bins on pavements."""
    bark = build.material(outdoor.bark(rng), (0.5, 0.5))
    leaves = street_furniture.foliage(build, rng)
    p = plan.pavement_m
    for k, (middle, yaw, length) in enumerate(plan.kerbsides()):
        with build.frame(middle, yaw):
            for n, at in enumerate((-0.25, 0.12)):
                if k % 4 < 2 and rng.random() < 0.85:
                    x = (at + rng.uniform(0.0, 0.1)) * length
                    with build.frame((x, -p - 1.0, -KERB_M), rng.choice([0.0, np.pi])):
                        street_furniture.car(build, rng, f"car {k}.{n}")
            for n, at in enumerate((-0.42, 0.0, 0.42)):
                with build.frame((at * length, -p + 0.35, 0.0)):
                    street_furniture.lamp_post(build, rng.uniform(4.6, 5.4), f"lamp post {k}.{n}")
            for n, at in enumerate((-0.2, 0.22)):
                with build.frame((at * length, -p + 0.5, 0.0), rng.uniform(0, 6)):
                    high = rng.uniform(4.2, 5.6)
                    street_furniture.tree(build, rng, bark, leaves, high, f"street tree {k}.{n}")
            with build.frame((rng.uniform(-0.12, -0.05) * length, -p + 0.45, 0.0)):
                street_furniture.bin_(build, rng, f"bin {k}")
            with build.frame((rng.uniform(0.06, 0.14) * length, -p + 0.6, 0.0), np.pi):
                street_furniture.bench(build, rng, f"bench {k}")
            with build.frame((0.47 * length, -p + 0.3, 0.0)):
                text = _NAMES[int(rng.integers(len(_NAMES)))]
                street_furniture.sign(build, rng, text, f"sign {k}")
