"""A factory hall: rows of similar racks, machines, columns, crates, painted lanes on the floor."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.furniture import decor, industrial
from ms_slam_env.scenes.lighting import Light, Lighting, Panel, light_and_expose
from ms_slam_env.scenes.mesh_scene import LargeScene
from ms_slam_env.scenes.room import Room
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import industrial as finish
from ms_slam_env.scenes.textures.noise import hsv

_KEY = 0.16
_CELL_M = 0.5
_AISLE_M = 3.0
_LANE_M = 3.4  # width of the lanes along the walls
_OFF_RACKS_M = 1.1
_LINES_M = 0.9  # distance of the lines from a lane's centre
_WAYS = (("A", "B"), ("B", "C"), ("C", "D"), ("D", "A"), ("E", "F"))


def factory_hall(seed: int) -> LargeScene:
    """Build the hall of ``seed``: 26 to 28 m long (x), 19 to 20 m wide (y), 6 m high.

    Places: "A", "B", "C", "D" at the corners of the lane around the racks, counter-clockwise, and
    the ends "E" (low x) and "F" of the middle aisle.
    """
    rng = np.random.default_rng([seed, 13])
    bays, rows = 6, 4
    length, width = bays * industrial.BAY_M, rows * industrial.RACK_DEPTH_M + 2 * _AISLE_M
    room = Room(
        (
            length + 2 * _LANE_M + rng.uniform(4.5, 5.5),
            width + 2 * _LANE_M + rng.uniform(1.0, 2.0),
            6.0,
        )
    )
    build = MeshBuilder(_CELL_M)
    of = industrial.stock(build, rng)
    tone = hsv(rng.choice([0.1, 0.36, 0.58]), rng.uniform(0.05, 0.25), rng.uniform(0.62, 0.82))
    wall = build.material(finish.corrugated(rng, tone), (2.5, 2.5))
    ceiling = build.material(finish.corrugated(rng, (120, 124, 128)), (3.0, 3.0))
    floor = build.material(finish.concrete(rng), (6.0, 6.0))
    room.shell(build, floor, (wall,) * 4, ceiling, skirting=build.plain((70, 74, 78)))
    x0, y0 = _LANE_M + 1.6, 0.5 * (room.size[1] - width)
    for row in range(rows):  # back to back in pairs would hide half of the goods
        # Aisles lie between rows 0 and 1 and between 2 and 3; 1 and 2 stand back to back.
        y = y0 + row * industrial.RACK_DEPTH_M + (row + 1) // 2 * _AISLE_M
        with build.frame((x0, y, 0)):
            industrial.rack(build, rng, of, bays, 3, f"rack {row}")
    _around(build, rng, of, room)
    places = _places(room, x0, y0, length, width)
    _markings(build, places)
    lamps = _lamps(build, rng, room)
    glow = {f"lamp {k}": (2.6, 2.6, 2.5) for k in range(len(lamps))}
    lighting = Lighting(
        tuple(lamps), glow, frozenset(glow), ambient=(0.22, 0.22, 0.22), bounce_rays=16
    )
    eyes = np.array([0.5 * (places[a] + places[b]) for a, b in _WAYS]) + np.array([0.0, 0.0, 1.5])
    mesh, exposure = light_and_expose(build, lighting, eyes, _KEY)

    def start(draw: Rng) -> tuple[Float64, Float64]:
        a, b = _WAYS[int(draw.integers(len(_WAYS)))]
        eye = places[a] + draw.uniform(0.1, 0.9) * (places[b] - places[a])
        eye = eye + np.array([*draw.uniform(-0.5, 0.5, 2), draw.uniform(1.2, 1.7)])
        angle = draw.uniform(-np.pi, np.pi)
        target = eye + draw.uniform(2.0, 6.0) * np.array([np.cos(angle), np.sin(angle), 0.0])
        target[2] = draw.uniform(0.6, 1.8)
        return eye, target

    return LargeScene(factory_hall, seed, mesh, start, exposure, places, eyes, lid_m=6.5)


def _places(room: Room, x0: float, y0: float, length: float, width: float) -> dict[str, Float64]:
    """Turning points on the lane around the racks and in the aisle between rows 0 and 1."""
    half = 0.5 * _LANE_M
    low_x, high_x = x0 - half, x0 + length + half
    low_y, high_y = y0 - _OFF_RACKS_M, y0 + width + _OFF_RACKS_M  # machines narrow these two lanes
    aisle = y0 + industrial.RACK_DEPTH_M + 0.5 * _AISLE_M
    other = y0 + 3 * industrial.RACK_DEPTH_M + 1.5 * _AISLE_M
    corners = {
        "A": (low_x, low_y),
        "B": (high_x, low_y),
        "C": (high_x, high_y),
        "D": (low_x, high_y),
        "E": (low_x, aisle),
        "F": (high_x, aisle),
        "G": (low_x, other),
        "H": (high_x, other),
    }
    return {name: np.array([x, y, 0.0]) for name, (x, y) in corners.items()}


def _around(build: MeshBuilder, rng: Rng, of: industrial.Stock, room: Room) -> None:
    """Machines, crates, drums, doors, panels and pipes along the walls; columns in the corners."""
    for wall in range(4):
        half = room.length(wall) / 2
        at, number = -half + 1.2, 0
        while at < half - 3.4:
            kind = rng.random()
            name = f"{wall}.{number}"
            if kind < 0.3:
                with room.at_wall(build, wall, at, gap=1.6):
                    industrial.machine(build, rng, of, f"machine {name}")
                at += 3.3
            elif kind < 0.6:
                for n in range(int(rng.integers(1, 3))):
                    with (
                        room.at_wall(build, wall, at + 1.25 * n, gap=1.05),
                        build.object(f"load {name}.{n}"),
                    ):
                        industrial.pallet_load(build, rng, of, 1.1, rng.uniform(0.8, 1.7))
                at += 2.9
            elif kind < 0.8:
                for n in range(int(rng.integers(2, 5))):
                    with room.at_wall(build, wall, at + 0.3 + 0.64 * n, gap=0.35):
                        industrial.drum(build, rng, f"drum {name}.{n}")
                at += 3.0
            else:
                with room.at_wall(build, wall, at + 0.7):
                    decor.door(build, rng, f"door {name}", hsv(rng.random(), 0.5, 0.5))
                with room.at_wall(build, wall, at + 2.0, z=1.8):
                    decor.picture_frame(build, rng, 1.1, 0.8, f"notice {name}")
                at += 3.0
            number += 1
        for n, along in enumerate(np.linspace(-half + 0.6, half - 0.6, 5)):
            with room.at_wall(build, wall, along, gap=0.3):
                industrial.column(build, of, room.size[2], f"column {wall}.{n}")
        pipe = build.plain((176, 60, 46) if wall % 2 else (90, 140, 150))
        with room.at_wall(build, wall, z=3.4), build.object(f"pipe {wall}"):
            build.box((-half + 0.1, -0.28, 0), (half - 0.1, -0.12, 0.16), pipe)


def _markings(build: MeshBuilder, places: dict[str, Float64]) -> None:
    """Yellow lines on both sides of the lanes, arrows in the middle."""
    yellow, white = build.plain((218, 178, 38)), build.plain((214, 214, 208))
    with build.object("floor markings"):
        for a, b in (("A", "B"), ("B", "C"), ("C", "D"), ("D", "A"), ("E", "F"), ("G", "H")):
            way = places[b] - places[a]
            length = float(np.linalg.norm(way))
            yaw = float(np.arctan2(way[1], way[0]))
            side = _LINES_M if a in "ABCD" else 0.5 * _AISLE_M - 0.3
            with build.frame(places[a] + np.array([0.0, 0.0, 0.004]), yaw):
                for y in (-side, side):
                    build.quad((side, y - 0.05, 0), (length - 2 * side, 0, 0), (0, 0.1, 0), yellow)
                for x in np.arange(2.5, length - 2.0, 3.5):
                    build.quad((x, -0.08, 0), (0.9, 0, 0), (0, 0.16, 0), white)
                    build.patch(
                        [
                            [(x + 0.9, -0.25, 0), (x + 1.4, -0.01, 0)],
                            [(x + 0.9, 0.25, 0), (x + 1.4, 0.01, 0)],
                        ],
                        white,
                    )


def _lamps(build: MeshBuilder, rng: Rng, room: Room) -> list[Light]:
    """Rows of panels under the ceiling, of slightly different strength."""
    w, d, h = room.size
    lights: list[Light] = []
    for x in np.linspace(0.14 * w, 0.86 * w, 4):
        for y in np.linspace(0.18 * d, 0.82 * d, 3):
            with build.frame((x, y, h)):
                decor.ceiling_lamp(build, 2.4, 0.6, f"lamp {len(lights)}")
            strength = tuple(np.array([1.0, 0.98, 0.93]) * 16.0 * rng.uniform(0.7, 1.0))
            corner = (x - 1.2, y + 0.3, h - 0.05)
            lights.append(Panel(corner, (2.4, 0, 0), (0, -0.6, 0), strength, (2, 1)))
    return lights
