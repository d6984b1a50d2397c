"""The paper's setting "wall": a wall with nearly no texture, a few things hanging on it."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes import tabletop
from ms_slam_env.scenes.base import Float64
from ms_slam_env.scenes.furniture import decor, storage
from ms_slam_env.scenes.mesh_scene import MeshScene

_CONTRAST = 0.35  # of the plaster; 1 is an ordinary wall


def wall(seed: int) -> MeshScene:
    """Build the wall of ``seed``: one or two pictures, a switch, a shelf, the rest bare."""
    rng = np.random.default_rng([seed, 5])
    size = (rng.uniform(3.6, 4.2), rng.uniform(2.6, 3.0), 2.5)
    setting = tabletop.begin(rng, size, wall_contrast=_CONTRAST)
    build, room = setting.build, setting.room
    w, d, _ = room.size
    side = float(rng.choice([-1, 1]))
    with room.at_wall(build, 0, side * rng.uniform(0.25, 0.45), z=rng.uniform(1.35, 1.5)):
        decor.picture_frame(build, rng, rng.uniform(0.35, 0.5), rng.uniform(0.3, 0.45), "picture 0")
    if rng.random() < 0.5:
        with room.at_wall(build, 0, side * rng.uniform(1.0, 1.3), z=1.45):
            decor.picture_frame(build, rng, 0.3, 0.4, "picture 1")
    with room.at_wall(build, 0, -side * rng.uniform(0.3, 0.5), z=1.1):
        decor.light_switch(build, "light switch")
    with room.at_wall(build, 0, -side * rng.uniform(1.1, 1.3), z=rng.uniform(1.25, 1.5)):
        storage.wall_shelf(build, rng, 0.6)
    with room.at_wall(build, 2, side * 0.6, gap=0.01):
        storage.bookshelf(build, rng, 0.9, 1.8, 5)
    with build.frame((0.4, 0.4, 0)):
        decor.plant(build, rng, 1.0, "plant")
    lamp = tabletop.ceiling_light(setting, rng, w / 2 + rng.uniform(-0.8, 0.8), d - 1.3)
    target = (w / 2, d, 1.25)
    start = tabletop.orbit(
        target, (0, -1), (0.55, 0.9), elevation=(-0.15, 0.25), azimuth=0.35, jitter_m=0.4
    )

    def on_wall(draw: np.random.Generator) -> tuple[Float64, Float64]:
        eye, look = start(draw)
        look[1] = d
        return eye, look

    glow = {"ceiling lamp": (4.0, 3.8, 3.4)}
    return tabletop.finish(
        setting,
        "wall",
        seed,
        (lamp,),
        glow,
        frozenset(glow),
        target,
        on_wall,
        key=0.3,
        start_objects=1,
    )
