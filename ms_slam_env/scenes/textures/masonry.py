"""Walls and hard floors: plaster, wallpaper, brick, tiles."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.textures.noise import Image, noise, shade


def plaster(
    rng: np.random.Generator, rgb: ArrayLike, contrast: float = 1.0, size: int = 512
) -> Image:
    """Painted plaster: faint clouds and roller stipple; ``contrast`` 0 is a perfect wall."""
    shape = (size, size)
    clouds, stipple = noise(rng, shape, 1.6), noise(rng, shape, 0.5)
    return shade(rgb, (0.022 * contrast, clouds), (0.014 * contrast, stipple))


def wallpaper(
    rng: np.random.Generator, rgb: ArrayLike, accent: ArrayLike, size: int = 512
) -> Image:
    """Stripes or a repeated ornament of colour ``accent`` on ``rgb``."""
    mask = np.zeros((size, size), np.uint8)
    if rng.random() < 0.5:
        step = size // int(rng.integers(4, 9))
        for x in range(0, size, step):
            mask[:, x : x + int(step * rng.uniform(0.15, 0.5))] = 255
    else:
        n = int(rng.integers(3, 6))
        cell = size / n
        petals = int(rng.integers(4, 8))
        for row in range(-1, 2 * n + 2):
            for column in range(-1, n + 1):
                centre = (int((column + 0.5 * (row % 2)) * cell), int(row * cell / 2))
                for k in range(petals):
                    cv2.ellipse(
                        mask,
                        centre,
                        (int(cell / 5), int(cell / 14)),
                        360.0 * k / petals,
                        -30,
                        200,
                        255,
                        -1,
                        cv2.LINE_AA,
                    )
                cv2.circle(mask, centre, int(cell / 12), 0, -1, cv2.LINE_AA)
    alpha = (0.65 * mask.astype(np.float32) / 255)[..., None]
    colour = (1 - alpha) * np.asarray(rgb, np.float32) + alpha * np.asarray(accent, np.float32)
    shape = (size, size)
    return shade(colour, (0.02, noise(rng, shape, 1.4)), (0.015, noise(rng, shape, 0.4)))


def _courses(
    rng: np.random.Generator, rows: int, columns: int, joint: float, bond: float, size: int
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


def brick(rng: np.random.Generator, rgb: ArrayLike, size: int = 512) -> Image:
    """Running bond, 8 courses of 3 bricks, pale mortar."""
    block, joint = _courses(rng, 8, 3, 0.07, 0.5, size)
    tone = (1.0 + 0.14 * rng.standard_normal(24).clip(-2, 2))[block % 24]
    colour = np.asarray(rgb, np.float32) * tone[..., None]
    colour = np.where(joint[..., None], np.array([178, 170, 158], np.float32), colour)
    shape = (size, size)
    return shade(colour, (0.07, noise(rng, shape, 0.8)), (0.05, noise(rng, shape, 1.5)))


def tiles(rng: np.random.Generator, rgb: ArrayLike, count: int = 4, size: int = 512) -> Image:
    """Square tiles of slightly different tone with grey grout and faint marbling."""
    block, joint = _courses(rng, count, count, 0.016, 0.0, size)
    tone = (1.0 + 0.045 * rng.standard_normal(count * count))[block % (count * count)]
    colour = np.asarray(rgb, np.float32) * tone[..., None]
    colour = np.where(joint[..., None], np.array([120, 116, 110], np.float32), colour)
    shape = (size, size)
    veins = np.exp(-np.abs(noise(rng, shape, 1.5)) * 9.0).astype(np.float32)
    return shade(colour, (-0.12, veins), (0.03, noise(rng, shape, 1.0)))
