"""The paper's setting "table": a cluttered table."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from ms_slam_env.scenes import tabletop
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.furniture import decor, electronics, seating, storage, tables, tableware
from ms_slam_env.scenes.mesh_scene import MeshScene
from ms_slam_env.scenes.textures import wood


def table(seed: int) -> MeshScene:
    """Build the table of ``seed`` with books, cups, plates, a laptop and more on it."""
    rng = np.random.default_rng([seed, 3])
    setting = tabletop.begin(rng, (rng.uniform(3.0, 3.6), rng.uniform(2.9, 3.4), 2.5))
    build, room = setting.build, setting.room
    w, d, _ = room.size
    width, depth, height = rng.uniform(1.3, 1.6), rng.uniform(0.75, 0.9), rng.uniform(0.72, 0.76)
    gap = rng.uniform(0.25, 0.5)
    board = build.material(wood.board(rng), (1.0, 1.0))
    with room.at_wall(build, 0, gap=gap):
        tables.table(build, width, depth, height, board)
        with build.frame((0, 0, height)):
            clutter(build, rng, width, depth)
    with room.at_wall(build, 0, rng.uniform(-0.3, 0.3), z=1.5):
        decor.picture_frame(build, rng, 0.7, 0.5, "picture 0")
    with room.at_wall(build, 3, 0.3, gap=0.01):
        storage.bookshelf(build, rng, 0.9, 1.8, 5)
    with room.at_wall(build, 1, 0.0, z=1.5):
        decor.picture_frame(build, rng, 0.5, 0.6, "picture 1")
    with build.frame((w - 0.4, d - 0.4, 0)):
        decor.plant(build, rng, 1.1, "plant")
    with build.frame((w / 2 + rng.uniform(-0.3, 0.3), d - gap - depth - 0.2, 0), yaw=np.pi):
        seating.chair(build, rng)
    lamp = tabletop.ceiling_light(setting, rng, w / 2 + rng.uniform(-0.4, 0.4), d - gap - 0.5)
    glow = {"ceiling lamp": (4.0, 3.8, 3.4), "laptop screen": (0.5, 0.5, 0.52)}
    target = (w / 2, d - gap - depth / 2, height)
    start = tabletop.orbit(target, (0, -1), elevation=(0.4, 0.9), jitter_m=0.2)
    clear = frozenset({"ceiling lamp"})
    return tabletop.finish(setting, "table", seed, (lamp,), glow, clear, target, start)


def clutter(build: MeshBuilder, rng: np.random.Generator, width: float, depth: float) -> None:
    """Put things on the rectangle [-width/2, width/2] x [-depth, 0] at z = 0."""
    with build.frame((rng.uniform(-0.2, 0.2), -0.3 * depth, 0), yaw=rng.uniform(-0.25, 0.25)):
        electronics.laptop(build, rng, "laptop")
    makers: dict[str, tuple[Callable[..., None], float]] = {
        "plate": (tableware.plate, 0.14),
        "bowl": (tableware.bowl, 0.15),
        "book": (partial(tableware.lying_book, thick_m=0.03), 0.14),
        "cup": (tableware.cup, 0.05),
        "bottle": (tableware.bottle, 0.045),
        "pens": (tableware.pen_pot, 0.045),
        "paper": (tableware.paper, 0.14),
        "vase": (partial(tableware.vase, height_m=0.22), 0.07),
        "magazine": (partial(tableware.lying_book, thick_m=0.008), 0.14),
        "second cup": (tableware.cup, 0.05),
    }
    names = list(makers)
    front = -0.3 * depth - 0.27  # the laptop stands behind this line, in the middle
    regions = {
        "left": ((-width / 2, -depth), (-0.2, 0.0)),
        "right": ((0.2, -depth), (width / 2, 0.0)),
        "front": ((-0.2, -depth), (0.2, front)),
    }
    for side, (low, high) in regions.items():
        order = [names[k] for k in rng.permutation(len(names))]
        spots = tables.place(rng, low, high, [makers[n][1] for n in order])
        for name, spot in zip(order, spots, strict=True):
            if spot is not None:
                with build.frame((*spot, 0.0), yaw=rng.uniform(-np.pi, np.pi)):
                    makers[name][0](build, rng, name=f"{name} {side}")
