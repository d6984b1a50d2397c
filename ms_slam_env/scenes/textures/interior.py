"""Interior materials: wooden boards and floors, plaster, wallpaper, brick, tiles."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures.noise import Field, Image, grain, noise, shade

TONES = np.array(
    [[176, 128, 82], [140, 94, 58], [205, 168, 122], [104, 68, 44], [190, 148, 96], [158, 118, 84]]
)
"""SRGB colours of oak, walnut, birch, mahogany, pine and teak."""


def _grain(rng: Rng, shape: tuple[int, int]) -> Field:
    """Fibres and growth rings along x, with about unit deviation."""
    h = shape[0]
    warp = noise(rng, shape, 1.8, 6.0)
    y = np.arange(h, dtype=np.float32)[:, None] / h
    rings = np.sin(2 * np.pi * (rng.integers(9, 16) * y + 1.3 * warp))
    fibres = noise(rng, shape, 0.9, 24.0)
    return (0.45 * rings + 0.8 * fibres + 0.5 * warp).astype(np.float32)


def board(rng: Rng, tone: ArrayLike | None = None, size: int = 512) -> Image:
    """Return a tileable board (size, size, 3), grain along x."""
    colour = TONES[rng.integers(len(TONES))] if tone is None else tone
    grain = _grain(rng, (size, size))
    return shade(colour, (0.085, grain), (0.03, noise(rng, (size, size), 0.4)))


def planks(rng: Rng, tone: ArrayLike, rows: int = 8, size: int = 1024) -> Image:
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


def plaster(rng: Rng, rgb: ArrayLike, contrast: float = 1.0, size: int = 512) -> Image:
    """Painted plaster: faint clouds and roller stipple; ``contrast`` 0 is a perfect wall."""
    shape = (size, size)
    clouds, stipple = noise(rng, shape, 1.6), noise(rng, shape, 0.5)
    return shade(rgb, (0.022 * contrast, clouds), (0.014 * contrast, stipple))


def wallpaper(rng: Rng, rgb: ArrayLike, accent: ArrayLike, size: int = 512) -> Image:
    """Stripes or a repeated ornament of colour ``accent`` on ``rgb``."""
    mask = np.zeros((size, size), np.uint8)
    if rng.random() < 0.5:
        step = size // int(rng.integers(4, 9))
        for x in range(0, size, step):
            mask[:, x : x + int(step * rng.uniform(0.15, 0.5))] = 255
    else:
        n = int(rng.integers(3, 6))
        cell = size / n
        petals, axes = int(rng.integers(4, 8)), (int(cell / 5), int(cell / 14))
        for row in range(-1, 2 * n + 2):
            for column in range(-1, n + 1):
                centre = (int((column + 0.5 * (row % 2)) * cell), int(row * cell / 2))
                for k in range(petals):
                    turn = 360.0 * k / petals
                    cv2.ellipse(mask, centre, axes, turn, -30, 200, 255, -1, cv2.LINE_AA)
                cv2.circle(mask, centre, int(cell / 12), 0, -1, cv2.LINE_AA)
    alpha = (0.65 * mask.astype(np.float32) / 255)[..., None]
    colour = (1 - alpha) * np.asarray(rgb, np.float32) + alpha * np.asarray(accent, np.float32)
    shape = (size, size)
    return grain(rng, colour, shape, (0.02, 1.4), (0.015, 0.4))


def _courses(
    rng: Rng, rows: int, columns: int, joint: float, bond: float, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Block index (size, size) and joint mask of a wall of ``rows`` x ``columns`` blocks."""
    y, x = np.mgrid[:size, :size] / size
    wobble = 0.0035 * noise(rng, (size, size), 1.3)
    y, x = (y + wobble) % 1.0, (x + 0.7 * wobble.T) % 1.0
    row = (y * rows).astype(int)
    shifted = (x * columns + bond * (row % 2)) % columns
    fy, fx = y * rows - row, shifted % 1.0
    aspect = rows / columns
    is_joint = (np.minimum(fy, 1 - fy) < joint) | (np.minimum(fx, 1 - fx) < joint / aspect)
    return row * columns + shifted.astype(int), is_joint


def brick(rng: Rng, rgb: ArrayLike, size: int = 512) -> Image:
    """Running bond, 8 courses of 3 bricks, pale mortar."""
    block, joint = _courses(rng, 8, 3, 0.07, 0.5, size)
    tone = (1.0 + 0.14 * rng.standard_normal(24).clip(-2, 2))[block % 24]
    colour = np.asarray(rgb, np.float32) * tone[..., None]
    colour = np.where(joint[..., None], np.array([178, 170, 158], np.float32), colour)
    shape = (size, size)
    return grain(rng, colour, shape, (0.07, 0.8), (0.05, 1.5))


def tiles(rng: Rng, rgb: ArrayLike, count: int = 4, size: int = 512) -> Image:
    """Square tiles of slightly different tone with grey grout and faint marbling."""
    block, joint = _courses(rng, count, count, 0.016, 0.0, size)
    tone = (1.0 + 0.045 * rng.standard_normal(count * count))[block % (count * count)]
    colour = np.asarray(rgb, np.float32) * tone[..., None]
    colour = np.where(joint[..., None], np.array([120, 116, 110], np.float32), colour)
    shape = (size, size)
    veins = np.exp(-np.abs(noise(rng, shape, 1.5)) * 9.0).astype(np.float32)
    return shade(colour, (-0.12, veins), (0.03, noise(rng, shape, 1.0)))
