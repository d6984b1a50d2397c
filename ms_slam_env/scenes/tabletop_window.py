"""The paper's setting "window": a desk under a bright window, the exposure set for the desk."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes import tabletop
from ms_slam_env.scenes.furniture import decor, electronics, tables, tableware
from ms_slam_env.scenes.lighting import Panel, Sun
from ms_slam_env.scenes.mesh_scene import MeshScene
from ms_slam_env.scenes.room import PANE, Window
from ms_slam_env.scenes.textures import wood

_SKY = 9.0  # radiance of the sky in the units of the baked light; the desk gets 1 to 2


def window(seed: int) -> MeshScene:
    """Build the window of ``seed``: pane saturates the sensor, objects on the sill stand dark."""
    rng = np.random.default_rng([seed, 4])
    height = rng.uniform(0.72, 0.76)
    opening = Window(
        rng.uniform(-0.2, 0.2), height + rng.uniform(0.12, 0.22), rng.uniform(1.2, 1.6), 1.25
    )
    size = (rng.uniform(2.8, 3.4), rng.uniform(2.8, 3.3), 2.55)
    setting = tabletop.begin(rng, size, windows={0: opening})
    build, room = setting.build, setting.room
    w, d, _ = room.size
    width, depth = rng.uniform(1.3, 1.6), rng.uniform(0.62, 0.75)
    board = build.material(wood.board(rng), (1.0, 1.0))
    with room.at_wall(build, 0, opening.along, gap=0.13):
        tables.table(build, width, depth, height, board, "desk")
        with build.frame((0, 0, height)):
            side = rng.choice([-1, 1])
            with build.frame((side * 0.3, -0.2, 0), yaw=rng.uniform(-0.2, 0.2)):
                electronics.laptop(build, rng, "laptop")
            with build.frame((-side * 0.25, -0.25, 0)):
                tableware.paper(build, rng, "paper")
            with build.frame((-side * 0.5, -0.3, 0)):
                tableware.lying_book(build, rng, "book", 0.035)
            with build.frame((-side * 0.08, -0.15, 0), yaw=1.0):
                tableware.cup(build, rng, "cup")
            with build.frame((side * 0.58, -0.35, 0)):
                tableware.pen_pot(build, rng, "pens")
    sill = [x for x in np.linspace(-opening.width / 2 + 0.15, opening.width / 2 - 0.15, 4)]
    with room.at_wall(build, 0, opening.along, z=opening.sill):
        for k, x in enumerate(sill):
            with build.frame((x + rng.uniform(-0.05, 0.05), -0.02, 0)):
                kind = rng.integers(3)
                if kind == 0:
                    decor.plant(build, rng, rng.uniform(0.3, 0.42), f"sill plant {k}")
                elif kind == 1:
                    tableware.vase(build, rng, rng.uniform(0.14, 0.24), f"sill vase {k}")
                else:
                    tableware.bottle(build, rng, f"sill bottle {k}")
    cloth = decor.curtain_cloth(rng)
    top = opening.sill + opening.height + 0.12
    for k, side in enumerate((-1, 1)):
        x = opening.along + side * (opening.width / 2 + 0.16)
        with room.at_wall(build, 0, x, z=top):
            decor.curtain(build, rng, 0.4, top - height - 0.02, cloth, f"curtain {k}")
    for wall in (1, 3):
        with room.at_wall(build, wall, rng.uniform(-0.3, 0.3), z=1.5):
            decor.picture_frame(build, rng, 0.6, 0.5, f"picture {wall}")
    a = opening.along - opening.width / 2
    corner = room.to_world(0, (a, 0.14, opening.sill))
    along = room.to_world(0, (a + opening.width, 0.14, opening.sill)) - corner
    sky = (_SKY * 0.93, _SKY, _SKY * 1.08)
    lights = (
        Panel(tuple(corner), tuple(along), (0, 0, opening.height), sky, (4, 3)),
        Sun((rng.uniform(-0.5, 0.5), 1.0, rng.uniform(0.9, 1.3)), (4.0, 3.7, 3.1)),
    )
    target = np.array([w / 2 + opening.along, d - 0.4, height + 0.12])
    start = tabletop.orbit(target, (0, -1), elevation=(0.05, 0.6), azimuth=0.7, jitter_m=0.2)
    glow = {PANE: sky, "laptop screen": (1.0, 1.0, 1.05)}
    clear = frozenset({PANE})
    return tabletop.finish(setting, "window", seed, lights, glow, clear, target, start, key=0.2)
