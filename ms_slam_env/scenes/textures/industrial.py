"""Factory finishes: concrete, corrugated metal, cardboard, crates, hazard stripes, panels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures.noise import Image, grain, hsv, noise, shade, write


def concrete(rng: Rng, rgb: ArrayLike = (150, 149, 145), size: int = 1024) -> Image:
    """Power-floated slab: clouds, tyre marks, pits and expansion joints along the edges."""
    shape = (size, size)
    image = grain(rng, rgb, shape, (0.09, 1.5), (0.04, 0.3)).astype(np.float32)
    for _ in range(7):  # tyre marks
        at, to = rng.uniform(0, size, 2), rng.uniform(0, size, 2)
        mark = np.zeros(shape, np.uint8)
        cv2.line(mark, tuple(at.astype(int).tolist()), tuple(to.astype(int).tolist()), 255, 9)
        worn = (mark > 0) & (noise(rng, shape, 1.0) > -0.2)
        image[worn] *= 0.78
    for _ in range(40):  # oil and paint
        centre = tuple(rng.integers(0, size, 2).tolist())
        cv2.circle(image, centre, int(rng.integers(2, 14)), (88, 84, 78), -1, cv2.LINE_AA)
    image[:4], image[:, :4] = 70, 70
    return np.clip(image, 0, 255).astype(np.uint8)


def corrugated(rng: Rng, rgb: ArrayLike, count: int = 10, size: int = 512) -> Image:
    """Painted trapezoidal sheet, ribs along the rows' direction y, streaks of rust."""
    x = np.arange(size) * count / size % 1.0
    rib = 0.86 + 0.22 * np.clip(3.0 * np.sin(2 * np.pi * x), -1, 1)
    rust = np.clip(noise(rng, (size, size), 1.2, 8.0).T - 1.0, 0, 1)[..., None]
    colour = np.asarray(rgb, float) * rib[None, :, None] * np.ones((size, 1, 1))
    colour = (1 - 0.6 * rust) * colour + 0.6 * rust * np.array([122.0, 78, 48])
    return grain(rng, colour, (size, size), (0.05, 1.3))


def cardboard(rng: Rng, size: int = 192) -> Image:
    """Side of a box: tape, a label with a bar code, arrows and letters."""
    tone = hsv(0.085, rng.uniform(0.32, 0.5), rng.uniform(0.55, 0.78))
    image = np.full((size, size, 3), tone, np.float32)
    image[:, size // 2 - 9 : size // 2 + 9] = tone * rng.uniform(0.8, 1.18)
    x, y = int(rng.uniform(0.06, 0.4) * size), int(rng.uniform(0.1, 0.45) * size)
    w, h = int(0.45 * size), int(0.32 * size)
    image[y : y + h, x : x + w] = (236, 234, 226)
    at = x + 6
    while at < x + w - 8:
        wide = int(rng.integers(1, 6))
        image[y + h // 2 : y + h - 5, at : at + wide] = 25
        at += wide + int(rng.integers(1, 5))
    letters = "".join("ABCDEFGHKLMNPRSTX0123456789"[k] for k in rng.integers(0, 27, 5))
    mask = np.zeros((size, size), np.uint8)
    cv2.putText(mask, letters, (x + 6, y + h // 2 - 4), cv2.FONT_HERSHEY_DUPLEX, 0.62, 255, 1)
    place = (int(0.1 * size), int(0.92 * size))
    cv2.putText(mask, letters[::-1], place, cv2.FONT_HERSHEY_DUPLEX, 1.1, 255, 2)
    image[mask > 96] = 35
    return grain(rng, image, (size, size), (0.05, 0.9), (0.04, 1.5))


def crate(rng: Rng, size: int = 256) -> Image:
    """Wooden crate: planks in a frame with a brace, nails and a stencil."""
    tone = hsv(0.09, rng.uniform(0.4, 0.55), rng.uniform(0.5, 0.72))
    rows = 5
    y = np.arange(size) * rows / size
    tones = (1.0 + 0.1 * rng.standard_normal(rows))[y.astype(int)] * np.where(y % 1 < 0.07, 0.4, 1)
    image = (tone * tones[:, None, None] * np.ones((1, size, 1))).astype(np.float32)
    brace = np.zeros((size, size), np.uint8)
    cv2.line(brace, (0, size), (size, 0), 255, size // 9)
    image[brace > 0] = tone * 0.86
    edge = size // 9
    for side in (slice(0, edge), slice(size - edge, size)):
        image[side], image[:, side] = tone * 1.08, tone * 1.04
    text = f"{rng.integers(10, 99)}-{rng.integers(100, 999)}"
    write(image, text, (size // 6, int(0.62 * size)), (cv2.FONT_HERSHEY_DUPLEX, 1.2, 3), 40)
    grain = noise(rng, (size, size), 0.9, 10.0)
    return shade(image, (0.09, grain), (0.04, noise(rng, (size, size), 1.3)))


def hazard(size: int = 128) -> Image:
    """Yellow and black slanting stripes."""
    y, x = np.mgrid[:size, :size]
    stripe = ((x + y) * 4 // size) % 2 == 0
    return np.where(stripe[..., None], (226, 184, 34), (38, 36, 34)).astype(np.uint8)


def control_panel(rng: Rng, rgb: ArrayLike, size: int = 256) -> Image:
    """Front of a machine: grilles, lamps, buttons, gauges, a display and a plate."""
    image = np.full((size, size, 3), np.asarray(rgb, float), np.float32)
    cv2.rectangle(image, (8, 8), (size - 8, size - 8), (np.asarray(rgb) * 0.7).tolist(), 3)
    a, b = int(rng.uniform(0.08, 0.4) * size), int(rng.uniform(0.08, 0.3) * size)
    image[b : b + size // 4, a : a + size // 3] = hsv(0.55, 0.6, 0.3)
    for k in range(5):
        y = b + 8 + k * size // 24
        cv2.line(image, (a + 6, y), (a + int(rng.integers(20, 70)), y), (120, 230, 160), 2)
    for k in range(int(rng.integers(4, 9))):
        at = (int((0.1 + 0.1 * k) * size), int(0.62 * size))
        cv2.circle(image, at, 8, hsv(rng.random(), 0.9, 0.9).tolist(), -1, cv2.LINE_AA)
    for k in range(int(rng.integers(1, 4))):
        at = (int((0.58 + 0.14 * k) * size), int(0.32 * size))
        cv2.circle(image, at, 15, (236, 234, 228), -1, cv2.LINE_AA)
        cv2.line(image, at, (at[0] + int(rng.integers(-10, 11)), at[1] - 11), (200, 30, 30), 2)
    for k in range(9):  # grille
        y = int((0.74 + 0.022 * k) * size)
        cv2.line(image, (size // 8, y), (int(0.86 * size), y), (40, 40, 42), 2)
    return grain(rng, image, (size, size), (0.04, 0.8), (0.05, 1.4))
