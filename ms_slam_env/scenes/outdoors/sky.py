"""The dome that stands for the sky."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.large_scene import SKY
from ms_slam_env.scenes.textures import street

RADIUS_M = 150.0
_LOWEST_RAD = np.radians(-12.0)


def sky_dome(build: MeshBuilder, rng: np.random.Generator, centre: tuple[float, float]) -> None:
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
        image = build.material(street.sky(rng))
        build.patch(grid[:, ::-1], image, np.stack([u, v], -1)[:, ::-1], inset=False)
