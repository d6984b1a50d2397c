"""Tables and desks; the top is centred on the origin in x, its far edge at y = 0."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder


def table(
    build: MeshBuilder,
    width_m: float,
    depth_m: float,
    height_m: float,
    material: Material,
    name: str = "table",
) -> None:
    """Board on four legs with an apron."""
    half, leg, thick = width_m / 2, 0.055, 0.03
    with build.object(name):
        build.box((-half, -depth_m, height_m - thick), (half, 0, height_m), material)
        for x in (-half + 0.03, half - 0.03 - leg):
            for y in (-depth_m + 0.03, -0.03 - leg):
                build.box((x, y, 0), (x + leg, y + leg, height_m - thick), material, "zZ")
        if height_m > 0.55:
            for y in (-depth_m + 0.045, -0.06):
                build.box(
                    (-half + 0.08, y, height_m - 0.11),
                    (half - 0.08, y + 0.02, height_m - thick),
                    material,
                    "xXZ",
                )


def place(
    rng: np.random.Generator,
    low: tuple[float, float],
    high: tuple[float, float],
    radii: list[float],
    tries: int = 60,
) -> list[tuple[float, float] | None]:
    """Throw discs of the given radii into a rectangle without overlap; None where none fits."""
    placed: list[tuple[float, float, float]] = []
    result: list[tuple[float, float] | None] = []
    for r in radii:
        spot = None
        for _ in range(tries):
            if low[0] + r > high[0] - r or low[1] + r > high[1] - r:
                break
            x = rng.uniform(low[0] + r, high[0] - r)
            y = rng.uniform(low[1] + r, high[1] - r)
            if all(np.hypot(x - a, y - b) > r + c for a, b, c in placed):
                spot = (float(x), float(y))
                placed.append((*spot, r))
                break
        result.append(spot)
    return result
