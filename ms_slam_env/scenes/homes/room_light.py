"""The light of a dwelling: windows, sun, lamps of each room, strong enough for its size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ms_slam_env.scenes.base import Float64, Rng
from ms_slam_env.scenes.homes.arrangement import Furnisher
from ms_slam_env.scenes.homes.floor_plan import FloorPlan, RoomPlan
from ms_slam_env.scenes.homes.interior import lamp_size
from ms_slam_env.scenes.lighting import Lamp, Light, Lighting, Panel, RoomLight, Sun
from ms_slam_env.scenes.room import PANE, Room, Window

_SKY = np.array([0.95, 1.0, 1.08]) * 6.0
_WARM = np.array([1.0, 0.9, 0.75])
_BULB = np.array([1.0, 0.78, 0.5])
_LEVEL = (0.09, 0.13)  # flux of all light of a room over the area of its surfaces
_LEAST_LAMP = 0.015  # of the lamp under the ceiling, in the same units
_REVEAL_M = 0.14  # the light of a window comes from behind its reveal


def home_lighting(rng: Rng, plan: FloorPlan, rooms: Sequence[Furnisher]) -> Lighting:
    """Daylight of one brightness for all windows, and lamps that make up for it room by room."""
    day = rng.uniform(0.4, 1.0)
    sky = _SKY * day
    angle = rng.uniform(0, 2 * np.pi)
    sun = (np.cos(angle), np.sin(angle), rng.uniform(0.5, 0.9))
    lights: list[Light] = [Sun(sun, tuple(np.array([3.0, 2.7, 2.2]) * rng.uniform(0.0, day)))]
    glow = {}
    for own, of in zip(plan.rooms, rooms, strict=True):
        w, d, h = of.room.size
        surface = 2 * (w * d + (w + d) * h)
        flux = rng.uniform(*_LEVEL) * surface
        panes = [_window_light(own, of.room, *one, sky) for one in own.windows]
        from_windows = sum(one.width * one.height for _, one in own.windows) * float(sky.mean())
        wide, deep = lamp_size(own)
        strength = max(_LEAST_LAMP * surface, flux - from_windows) / (wide * deep)
        x, y = np.add(own.low, own.high) / 2
        ceiling = Panel(
            (x - wide / 2, y + deep / 2, h - 0.05),
            (wide, 0, 0),
            (0, -deep, 0),
            tuple(_WARM * strength),
            (2, 2),
        )
        bulbs = [
            Lamp(
                tuple(np.add(place, (*own.low, 0.0))),
                tuple(_BULB * rng.uniform(0.04, 0.14)),
                0.08,
                2,
            )
            for place in of.bulbs
        ]
        low, high = (*own.low, 0.0), (*own.high, h)
        lights += [RoomLight(light, low, high) for light in (*panes, ceiling, *bulbs)]
        bright = min(3.0, 0.3 + 0.25 * strength)
        glow[f"{own.name} ceiling lamp"] = (bright, 0.96 * bright, 0.86 * bright)
        glow[f"{own.name} {PANE}"] = tuple(sky.tolist())
        glow[f"{own.name} lamp shade"] = (0.62, 0.51, 0.34)
        glow[f"{own.name} TV screen"] = (0.45, 0.47, 0.5)
    shining = frozenset(name for name in glow if not name.endswith("TV screen"))
    return Lighting(tuple(lights), glow, shining, bounce_rays=20)


def _window_light(own: RoomPlan, room: Room, wall: int, window: Window, sky: Float64) -> Panel:
    """The light of the sky through a window, in the dwelling's frame."""
    half = window.width / 2
    right, left = (
        room.to_world(wall, (window.along + side * half, _REVEAL_M, window.sill))
        for side in (1, -1)
    )
    # The front of the panel, edge_u x edge_v, faces the room.
    origin = tuple(np.add(left, (*own.low, 0.0)).tolist())
    return Panel(origin, tuple(right - left), (0, 0, window.height), tuple(sky), (3, 2))
