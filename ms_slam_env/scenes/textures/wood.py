"""Wood: grain, boards of furniture, planked floors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.textures.noise import Field, Image, noise, shade

TONES = np.array(
    [[176, 128, 82], [140, 94, 58], [205, 168, 122], [104, 68, 44], [190, 148, 96], [158, 118, 84]]
)
"""SRGB colours of oak, walnut, birch, mahogany, pine and teak."""


def _grain(rng: np.random.Generator, shape: tuple[int, int]) -> Field:
    """Fibres and growth rings along x, unit deviation or so."""
    h = shape[0]
    warp = noise(rng, shape, 1.8, 6.0)
    y = np.arange(h, dtype=np.float32)[:, None] / h
    rings = np.sin(2 * np.pi * (rng.integers(9, 16) * y + 1.3 * warp))
    fibres = noise(rng, shape, 0.9, 24.0)
    return (0.45 * rings + 0.8 * fibres + 0.5 * warp).astype(np.float32)


def board(rng: np.random.Generator, tone: ArrayLike | None = None, size: int = 512) -> Image:
    """Return a tileable board (size, size, 3), grain along x."""
    colour = TONES[rng.integers(len(TONES))] if tone is None else tone
    grain = _grain(rng, (size, size))
    return shade(colour, (0.085, grain), (0.03, noise(rng, (size, size), 0.4)))


def planks(rng: np.random.Generator, tone: ArrayLike, rows: int = 8, size: int = 1024) -> Image:
    """Tileable floor of planks along x, each with its own grain and tone."""
    grain = _grain(rng, (size, size))
    row = np.arange(size) * rows // size
    start = rng.uniform(0, 1, rows)
    second = rng.uniform(0.35, 0.65, rows)
    x = (np.arange(size)[None, :] / size - start[row][:, None]) % 1.0
    half = (x > second[row][:, None]).astype(int)
    plank = 2 * row[:, None] + half  # (size, size)
    count = 2 * rows
    dy, dx = rng.integers(0, size, (2, count))
    yy, xx = np.arange(size)[:, None], np.arange(size)[None, :]
    own_grain = grain[(yy + dy[plank]) % size, (xx + dx[plank]) % size]
    tint = 1.0 + 0.10 * rng.standard_normal(count).clip(-2, 2)[plank]
    warm = 1.0 + 0.03 * rng.standard_normal(count).clip(-2, 2)[plank]
    edge_y = (np.arange(size) * rows % size < 2 * rows)[:, None]
    edge_x = np.minimum(x, np.abs(x - second[row][:, None])) < 1.5 / size
    seam = np.where(edge_y | edge_x, 0.45, 1.0)
    colour = np.asarray(tone, dtype=np.float32) * (tint * seam)[..., None]
    colour[..., 0] *= warm
    return shade(colour, (0.075, own_grain), (0.04, noise(rng, (size, size), 1.2)))
