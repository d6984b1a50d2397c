"""The paper's setting "carpet": looking down at a flat carpet that looks the same everywhere."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes import tabletop
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.furniture import decor, seating, storage, tableware
from ms_slam_env.scenes.mesh_scene import MeshScene
from ms_slam_env.scenes.textures import fabric
from ms_slam_env.scenes.textures.noise import hsv

_TILE_M = 0.4  # the pile repeats after this


def carpet(seed: int) -> MeshScene:
    """Build the carpet of ``seed``: pile from wall to wall, furniture only at the walls."""
    rng = np.random.default_rng([seed, 6])
    build = MeshBuilder(tabletop.CELL_M)
    colour = hsv(
        rng.choice([0.08, 0.1, 0.33, 0.58, 0.62, 0.95]),
        rng.uniform(0.08, 0.4),
        rng.uniform(0.4, 0.65),
    )
    pile = build.material(fabric.carpet_pile(rng, colour), (_TILE_M, _TILE_M))
    size = (rng.uniform(3.4, 4.0), rng.uniform(3.2, 3.6), 2.5)
    setting = tabletop.begin(rng, size, floor=pile, build=build)
    room = setting.room
    w, d, _ = room.size
    with room.at_wall(build, 0, 0.0, gap=0.05):
        seating.sofa(build, rng, 1.8, 2)
    with room.at_wall(build, 3, 0.2, gap=0.01):
        storage.bookshelf(build, rng, 0.9, 1.8, 5)
    with room.at_wall(build, 1, 0.0, z=1.5):
        decor.picture_frame(build, rng, 0.7, 0.5, "picture")
    target = np.array([w / 2, 0.42 * d, 0.0])
    where = target + np.array(
        [rng.uniform(0.55, 0.75) * rng.choice([-1, 1]), rng.uniform(-0.3, 0.3), 0.0]
    )
    with build.frame(where):
        tableware.lying_book(build, rng, "magazine", 0.01)
    lamp = tabletop.ceiling_light(setting, rng, w / 2, d / 2)
    start = tabletop.orbit(
        target, (0, -1), (0.6, 0.9), elevation=(0.8, 1.3), azimuth=np.pi, jitter_m=0.3
    )
    glow = {"ceiling lamp": (4.0, 3.8, 3.4)}
    return tabletop.finish(
        setting,
        "carpet",
        seed,
        (lamp,),
        glow,
        frozenset(glow),
        target,
        start,
        key=0.22,
        start_objects=1,
    )
