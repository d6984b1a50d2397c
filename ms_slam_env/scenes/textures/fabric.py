"""Fabric: woven upholstery, patterned rugs, carpet pile."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures.noise import Field, Image, hsv, noise, shade


def weave(rng: Rng, rgb: ArrayLike, threads: int = 64, size: int = 256) -> Image:
    """Plain weave of ``threads`` threads in each direction, unevenly dyed and worn."""
    y, x = np.mgrid[:size, :size].astype(np.float32) * (np.pi * threads / size)
    over = np.sin(x) * np.sin(y)
    slub = noise(rng, (size, size), 0.6, 8.0) + noise(rng, (size, size), 0.6, 8.0).T
    return shade(rgb, (0.09, over), (0.045, slub), (0.06, noise(rng, (size, size), 1.4)))


def pattern(rng: Rng, colours: NDArray[np.float64], size: int = 256) -> Image:
    """Woven stripes, checks or dots in some ``colours`` (n, 3), for cushions and curtains."""
    kind = rng.integers(3)
    image = np.broadcast_to(colours[0], (size, size, 3)).astype(np.float32).copy()
    n = int(rng.integers(4, 9))
    if kind == 0:
        for k in range(n):
            low = k * size // n
            image[:, low : low + int(size / n * rng.uniform(0.2, 0.7))] = colours[
                1 + k % (len(colours) - 1)
            ]
    elif kind == 1:
        for k in range(n):
            low, wide = k * size // n, size // (3 * n)
            image[:, low : low + wide] = 0.5 * image[:, low : low + wide] + 0.5 * colours[1]
            image[low : low + wide] = 0.5 * image[low : low + wide] + 0.5 * colours[1]
    else:
        for row in range(n):
            for column in range(n):
                at = ((column + 0.5 * (row % 2)) * size / n, (row + 0.5) * size / n)
                colour = colours[1 + (row + column) % (len(colours) - 1)]
                cv2.circle(image, (int(at[0]), int(at[1])), size // (4 * n), colour.tolist(), -1)
    return weave_over(rng, image)


def weave_over(rng: Rng, image: NDArray[np.float32]) -> Image:
    """Lay threads and wear over a printed or knotted design (h, w, 3)."""
    h, w = image.shape[:2]
    y, x = np.mgrid[:h, :w].astype(np.float32)
    threads = np.sin(x * 1.45) * np.sin(y * 1.45)
    return shade(
        image, (0.06, threads), (0.055, noise(rng, (h, w), 0.5)), (0.05, noise(rng, (h, w), 1.3))
    )


def rug(rng: Rng, size: int = 512) -> Image:
    """Oriental or geometric rug: borders, a mirrored field of motifs, a medallion."""
    hue = float(rng.choice([0.0, 0.02, 0.06, 0.1, 0.56, 0.62, 0.45]))
    palette = np.array(
        [
            hsv(hue, rng.uniform(0.5, 0.8), rng.uniform(0.3, 0.55)),
            hsv(hue + rng.uniform(0.4, 0.6), rng.uniform(0.4, 0.7), rng.uniform(0.2, 0.4)),
            hsv(rng.uniform(0.08, 0.14), rng.uniform(0.2, 0.4), rng.uniform(0.75, 0.9)),
            hsv(hue + rng.uniform(-0.15, 0.15), rng.uniform(0.4, 0.8), rng.uniform(0.5, 0.8)),
            hsv(rng.random(), 0.3, 0.15),
        ]
    )
    half = size // 2
    quarter = np.broadcast_to(palette[0], (half, half, 3)).astype(np.float32).copy()
    edge = half // 4
    for _ in range(70):  # motifs of the field
        x, y = rng.integers(edge, half, 2)
        r = int(rng.integers(half // 40, half // 11))
        colour = palette[rng.integers(1, 5)].tolist()
        shape = rng.integers(3)
        if shape == 0:
            cv2.circle(quarter, (int(x), int(y)), r, colour, -1 if rng.random() < 0.5 else 3)
        elif shape == 1:
            diamond = np.array([[x - r, y], [x, y - r], [x + r, y], [x, y + r]], np.int32)
            cv2.fillPoly(quarter, [diamond], colour)
        else:
            angle = float(rng.uniform(0, 180))
            cv2.ellipse(quarter, (int(x), int(y)), (r, max(2, r // 3)), angle, 0, 360, colour, -1)
    for k, ring in enumerate((0.42, 0.32, 0.2, 0.1)):  # medallion at the centre
        r = int(half * ring)
        corners = [[half - r, half], [half, half - r], [half + r, half]]
        cv2.fillPoly(quarter, [np.array(corners, np.int32)], palette[(k + 1) % 5].tolist())
    band = 0
    for k in range(6):  # border bands, every second one with teeth
        width = int(rng.integers(half // 40, half // 14))
        colour = palette[(k * 2 + 1) % 5]
        low, high = band, min(band + width, edge)
        quarter[low:high, low:] = colour
        quarter[low:, low:high] = colour
        if k % 2:
            tooth = max(4, half // 24)
            other = palette[(k * 2 + 3) % 5].tolist()
            for s in range(low + tooth, half, 2 * tooth):
                middle = (low + high) // 2
                cv2.circle(quarter, (s, middle), max(2, width // 3), other, -1)
                cv2.circle(quarter, (middle, s), max(2, width // 3), other, -1)
        band += width
    top = np.concatenate([quarter, quarter[:, ::-1]], 1)
    return weave_over(rng, np.concatenate([top, top[::-1]], 0))


def _band(rng: Rng, size: int, cycles: float) -> Field:
    """Tileable noise around ``cycles`` cycles an image, unit deviation."""
    fy, fx = fft.fftfreq(size)[:, None] * size, fft.rfftfreq(size)[None, :] * size
    spectrum = np.exp(-(((np.hypot(fy, fx) - cycles) / (0.35 * cycles)) ** 2))
    white = rng.standard_normal((size, size), dtype=np.float32)
    field = fft.irfft2(fft.rfft2(white) * spectrum.astype(np.float32), (size, size))
    return (field / field.std()).astype(np.float32)


def carpet_pile(rng: Rng, rgb: ArrayLike, size: int = 512) -> Image:
    """Loop pile in rows: tufts of one size and three similar tones, the same everywhere."""
    tufts = 64
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    jitter = 0.12 * _band(rng, size, 40.0)
    loops = np.cos(2 * np.pi * (tufts * x + jitter)) * np.cos(
        2 * np.pi * (tufts * y + 0.5 * np.floor(tufts * x) + jitter)
    )
    fibre = _band(rng, size, 110.0)
    cell = rng.integers(0, 3, (tufts, tufts))
    tone = (
        np.array([0.88, 1.0, 1.1], np.float32)[cell]
        .repeat(size // tufts, 0)
        .repeat(size // tufts, 1)
    )
    colour = np.asarray(rgb, np.float32) * tone[..., None]
    return shade(colour, (0.16, loops.astype(np.float32)), (0.07, fibre))
