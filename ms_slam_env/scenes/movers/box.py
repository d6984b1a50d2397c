"""A parcel."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.base import Rng
from ms_slam_env.scenes.builder import MeshBuilder
from ms_slam_env.scenes.movers.shape import Joint, Shape, assemble
from ms_slam_env.scenes.textures import pictures
from ms_slam_env.scenes.textures.noise import grain, hsv

_SIZE_M = (0.18, 0.36)  # of a side
_SIDES = "xXyYzZ"


def box(rng: Rng, size_m: tuple[float, float, float] | None = None) -> Shape:
    """Cardboard with prints, labels and tape; its origin is its middle.

    Args:
        rng: draws colours, prints and what is not given.
        size_m: along x, y and z.
    """
    half = 0.5 * np.array(size_m if size_m is not None else rng.uniform(*_SIZE_M, 3))
    paper = hsv(rng.uniform(0.06, 0.11), rng.uniform(0.3, 0.55), rng.uniform(0.55, 0.8))

    def add(build: MeshBuilder) -> None:
        for side in _SIDES:
            cardboard = build.material(_side(rng, paper), None)
            build.box(-half, half, cardboard, skip=_SIDES.replace(side, ""))

    parts = assemble([(add, Joint())], cell_m=0.1, ground_z=None)
    x, y, z = map(float, half)
    return Shape("box", parts, float(np.linalg.norm(half)), 2 * x, 2 * y, z, z)


def _side(rng: Rng, paper: np.ndarray, size: int = 256) -> np.ndarray:
    """One side: a print, one or two labels, tape across the middle."""
    image = np.broadcast_to(paper, (size, size, 3)).astype(np.float32).copy()
    for _ in range(int(rng.integers(1, 4))):
        h, w = (int(rng.uniform(0.2, 0.5) * size) for _ in range(2))
        y, x = int(rng.uniform(0.03, 0.97) * (size - h)), int(rng.uniform(0.03, 0.97) * (size - w))
        draw = pictures.page if rng.random() < 0.5 else pictures.cover
        image[y : y + h, x : x + w] = draw(rng, h, w)
    tape = size // 2
    image[tape - size // 24 : tape + size // 24] = 0.8 * image[tape - size // 24] + 40.0
    return grain(rng, image, (size, size), (0.06, 0.6), (0.05, 1.3))
