"""The sky, daylight with cast shadows, and the finished outdoor scene."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.lighting import Lighting, SkyLight, Sun, light_and_expose
from ms_slam_env.scenes.mesh_scene import SKY, LargeScene, SceneMaker
from ms_slam_env.scenes.outdoors.plan import StreetPlan
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import outdoor

RADIUS_M = 150.0
_LOWEST_RAD = np.radians(-12.0)


def sky_dome(build: MeshBuilder, rng: Rng, centre: tuple[float, float]) -> None:
    """Add a dome of ``RADIUS_M`` seen from inside, with clouds, around ``centre`` (x, y)."""
    elevation = np.linspace(_LOWEST_RAD, np.pi / 2, 14)[:, None]
    azimuth = np.linspace(0, 2 * np.pi, 37)[None, :]
    ring = np.cos(elevation)
    grid = np.stack(
        [
            centre[0] + RADIUS_M * ring * np.cos(azimuth),
            centre[1] + RADIUS_M * ring * np.sin(azimuth),
            RADIUS_M * np.sin(elevation) * np.ones_like(azimuth),
        ],
        -1,
    )
    u = np.broadcast_to(azimuth / (2 * np.pi), grid.shape[:2])
    up = np.clip(elevation, 0.0, None) / (np.pi / 2)
    v = np.broadcast_to(0.999 - 0.998 * up, grid.shape[:2])
    with build.object(SKY):
        image = build.material(outdoor.sky(rng))
        build.patch(grid[:, ::-1], image, np.stack([u, v], -1)[:, ::-1], inset=False)


_KEY = 0.16
_MOST_EXPOSED = 0.85
_EYE_M = (1.4, 1.8)
_STRAY_M = 0.5  # sideways deviation of start poses, across the street
_DEPTH_OF_VIEW_M = (3.0, 8.0)


def daylight_scene(
    maker: SceneMaker,
    seed: int,
    build: MeshBuilder,
    rng: Rng,
    plan: StreetPlan,
    places: Mapping[str, Float64],
    ways: tuple[tuple[str, str], ...],
) -> LargeScene:
    """Light the built mesh by a sun 35 to 55 degrees high, and make the scene.

    Args:
        maker: maker of the scene.
        seed: seed of the scene.
        build: everything except the sky.
        rng: draws the sun's position.
        plan: plan of the streets.
        places: points (3,) on the ground where routes turn, by name.
        ways: pairs of places between which start poses may lie.
    """
    x0, y0, x1, y1 = plan.bounds
    sky_dome(build, rng, ((x0 + x1) / 2, (y0 + y1) / 2))
    azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(35.0, 55.0))
    sun = (np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height))
    bright = rng.uniform(0.85, 1.15)
    lighting = Lighting(
        lights=(Sun(sun, tuple(np.array([2.9, 2.7, 2.35]) * bright)), SkyLight((0.62, 0.72, 0.9))),
        glow={SKY: (1.25, 1.25, 1.25)},
        clear=frozenset({SKY}),
        ambient=(0.05, 0.05, 0.05),
        bounce_rays=12,
        bounce_gain=1.5,
    )
    middles = np.array([0.5 * (places[a] + places[b]) for a, b in ways])
    eyes = middles + np.array([0.0, 0.0, 1.6])
    # Between tall houses most is shade; exposed for that alone, sunlit surfaces would be white.
    mesh, exposure = light_and_expose(build, lighting, eyes, _KEY)

    def start(draw: Rng) -> tuple[Float64, Float64]:
        a, b = ways[int(draw.integers(len(ways)))]
        if draw.random() < 0.5:
            a, b = b, a
        way = places[b] - places[a]
        length = np.linalg.norm(way)
        along = way / length
        across = np.array([-along[1], along[0], 0.0])
        eye = (
            places[a] + draw.uniform(0.15, 0.85) * way + draw.uniform(-_STRAY_M, _STRAY_M) * across
        )
        eye[2] = draw.uniform(*_EYE_M)
        angle = draw.uniform(-0.7, 0.7)
        ahead = np.cos(angle) * along + np.sin(angle) * across
        target = eye + draw.uniform(*_DEPTH_OF_VIEW_M) * ahead
        target[2] = draw.uniform(0.6, 1.6)
        return eye, target

    exposure = min(exposure, _MOST_EXPOSED)
    return LargeScene(maker, seed, mesh, start, exposure, places, eyes, lanes=plan.lanes())
