"""Leaves and potting soil."""

from __future__ import annotations

import numpy as np

from ms_slam_env.scenes.textures.noise import Image, hsv, noise, shade


def leaf(rng: np.random.Generator, size: int = 128) -> Image:
    """A leaf's surface, midrib along the rows in the middle column, side veins off it."""
    colour = hsv(rng.uniform(0.24, 0.36), rng.uniform(0.5, 0.75), rng.uniform(0.35, 0.55))
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    off = np.abs(x - 0.5)
    rib = np.exp(-((off / 0.02) ** 2))
    veins = np.exp(-(((((y + 0.8 * off) * 9.0) % 1.0 - 0.5) / 0.09) ** 2)) * (off < 0.46)
    image = shade(colour, (0.10, noise(rng, (size, size), 1.2)))
    light = (0.5 * rib + 0.22 * veins)[..., None]
    return np.clip(image + light * (np.array([205, 220, 150]) - image), 0, 255).astype(np.uint8)


def soil(rng: np.random.Generator, size: int = 128) -> Image:
    """Dark crumbly earth."""
    return shade((72, 52, 38), (0.3, noise(rng, (size, size), 0.5)))
