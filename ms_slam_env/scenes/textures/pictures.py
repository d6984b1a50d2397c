"""What hangs in picture frames and lies on covers: landscapes, abstracts, portraits, flowers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.textures.noise import Image, hsv, noise, shade

_Canvas = NDArray[np.float32]


def _gradient(h: int, w: int, top: NDArray[np.float64], bottom: NDArray[np.float64]) -> _Canvas:
    t = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    return np.ascontiguousarray(
        np.broadcast_to((1 - t) * top + t * bottom, (h, w, 3)), dtype=np.float32
    )


def _landscape(rng: np.random.Generator, h: int, w: int) -> _Canvas:
    """Sky, sun, receding ridges, water or fields, trees."""
    sky = rng.uniform(0.52, 0.64) if rng.random() < 0.6 else rng.uniform(0.02, 0.1)
    image = _gradient(h, w, hsv(sky, 0.6, 0.75), hsv(rng.uniform(0.05, 0.13), 0.25, 0.98))
    centre = (int(rng.uniform(0.15, 0.85) * w), int(rng.uniform(0.12, 0.35) * h))
    cv2.circle(image, centre, h // 14, (255, 244, 205), -1, cv2.LINE_AA)
    clouds = np.clip(noise(rng, (h, w), 1.7, 0.5) - 0.4, 0, 1.5)[..., None] / 1.5
    image[: h // 2] += (0.7 * clouds * (250 - image))[: h // 2]
    hue = rng.uniform(0.2, 0.62)
    for k in range(4):
        base = h * (0.42 + 0.13 * k)
        walk = np.cumsum(rng.standard_normal(w)) * h * 0.006
        walk += rng.uniform(0.02, 0.08) * h * np.sin(np.linspace(0, rng.uniform(3, 12), w) + k)
        ridge = base + walk - np.linspace(0, walk[-1], w)
        below = np.arange(h)[:, None] > ridge[None, :]
        colour = hsv(hue + 0.02 * k, 0.25 + 0.12 * k, 0.72 - 0.13 * k)
        image[below] = colour * (1 + 0.10 * noise(rng, (h, w), 1.0)[below][:, None])
    for _ in range(int(rng.integers(0, 9))):
        x, y = int(rng.uniform(0, w)), int(rng.uniform(0.68, 0.95) * h)
        s = int(h * rng.uniform(0.05, 0.13))
        cv2.line(image, (x, y), (x, y - s), (60, 42, 30), max(1, s // 8))
        cv2.ellipse(
            image,
            (x, y - int(1.4 * s)),
            (int(0.5 * s), s),
            0,
            0,
            360,
            hsv(rng.uniform(0.2, 0.38), 0.6, rng.uniform(0.2, 0.5)).tolist(),
            -1,
        )
    return image


def _abstract(rng: np.random.Generator, h: int, w: int) -> _Canvas:
    """Overlapping discs, bars and triangles of a small palette."""
    hues = rng.random() + np.array([0.0, rng.uniform(0.06, 0.15), rng.uniform(0.4, 0.6), 0.75])
    palette = [hsv(u, rng.uniform(0.3, 0.95), rng.uniform(0.3, 0.95)) for u in hues]
    image = _gradient(h, w, hsv(hues[0], 0.12, 0.95), hsv(hues[1], 0.2, 0.85))
    for _ in range(int(rng.integers(8, 26))):
        overlay = image.copy()
        colour = palette[rng.integers(4)].tolist()
        x, y = int(rng.uniform(0, w)), int(rng.uniform(0, h))
        r = int(rng.uniform(0.04, 0.28) * min(h, w))
        kind = rng.integers(4)
        if kind == 0:
            cv2.circle(overlay, (x, y), r, colour, -1, cv2.LINE_AA)
        elif kind == 1:
            box = cv2.boxPoints(((x, y), (3.0 * r, 0.6 * r), float(rng.uniform(0, 180))))
            cv2.fillPoly(overlay, [box.astype(np.int32)], colour, cv2.LINE_AA)
        elif kind == 2:
            corners = rng.uniform(-1.5 * r, 1.5 * r, (3, 2)) + np.array([x, y])
            cv2.fillPoly(overlay, [corners.astype(np.int32)], colour, cv2.LINE_AA)
        else:
            cv2.circle(overlay, (x, y), r, (30, 28, 32), max(2, r // 10), cv2.LINE_AA)
        alpha = rng.uniform(0.55, 1.0)
        image = alpha * overlay + (1 - alpha) * image
    return image.astype(np.float32)


def _portrait(rng: np.random.Generator, h: int, w: int) -> _Canvas:
    """A head and shoulders before a dark ground."""
    ground = hsv(rng.random(), 0.35, rng.uniform(0.25, 0.6))
    image = _gradient(h, w, ground * 1.2, ground * 0.6)
    skin = hsv(rng.uniform(0.04, 0.08), rng.uniform(0.3, 0.55), rng.uniform(0.45, 0.92))
    cloth = hsv(rng.random(), rng.uniform(0.3, 0.8), rng.uniform(0.15, 0.7))
    hair = hsv(rng.uniform(0.03, 0.1), 0.5, rng.uniform(0.08, 0.5))
    x, y, s = w // 2 + int(rng.uniform(-0.06, 0.06) * w), int(0.42 * h), min(h, w) / 2

    def ellipse(
        at: tuple[float, float],
        size: tuple[float, float],
        colour: NDArray[np.float64],
        angle: float = 0.0,
    ) -> None:
        centre = (int(x + s * at[0]), int(y + s * at[1]))
        axes = (max(1, int(s * size[0])), max(1, int(s * size[1])))
        cv2.ellipse(image, centre, axes, angle, 0, 360, colour.tolist(), -1, cv2.LINE_AA)

    ellipse((0, 1.35), (0.85, 0.75), cloth)
    ellipse((0, 0.0), (0.43, 0.58), hair)
    ellipse((0, 0.45), (0.15, 0.3), skin * 0.85)
    ellipse((0, 0.08), (0.33, 0.45), skin)
    for side in (-1, 1):
        ellipse((0.13 * side, 0.0), (0.06, 0.03), np.array([240.0, 240, 235]))
        ellipse((0.13 * side, 0.0), (0.025, 0.03), np.array([35.0, 25, 20]))
        ellipse((0.13 * side, -0.07), (0.075, 0.014), hair)
    ellipse((0.02, 0.13), (0.025, 0.07), skin * 0.82)
    ellipse((0, 0.29), (0.1, 0.024), np.array([150.0, 60, 60]))
    return image


def _flowers(rng: np.random.Generator, h: int, w: int) -> _Canvas:
    """A bunch of flowers in a vase."""
    hue = rng.random()
    image = _gradient(h, w, hsv(hue, 0.15, 0.9), hsv(hue + 0.1, 0.3, 0.65))
    base = (w // 2, int(0.72 * h))
    heads = np.stack([rng.normal(w / 2, w * 0.17, 14), rng.uniform(0.12, 0.5, 14) * h], -1)
    for head in heads.astype(int):
        cv2.line(image, base, tuple(head.tolist()), (52, 98, 44), 2, cv2.LINE_AA)
    for head in heads.astype(int):
        colour = hsv(hue + rng.uniform(0.3, 0.7), rng.uniform(0.4, 0.9), rng.uniform(0.6, 1.0))
        r = int(min(h, w) * rng.uniform(0.035, 0.075))
        for k in range(6):
            angle = k * np.pi / 3
            at = (int(head[0] + r * np.cos(angle)), int(head[1] + r * np.sin(angle)))
            cv2.circle(image, at, int(0.62 * r), (colour * rng.uniform(0.8, 1)).tolist(), -1)
        cv2.circle(image, tuple(head.tolist()), r // 2, (230, 190, 60), -1, cv2.LINE_AA)
    cv2.ellipse(
        image,
        (w // 2, int(0.82 * h)),
        (int(0.11 * w), int(0.15 * h)),
        0,
        0,
        360,
        hsv(hue + 0.5, 0.4, 0.5).tolist(),
        -1,
        cv2.LINE_AA,
    )
    return image


_KINDS = (_landscape, _abstract, _portrait, _flowers)


def picture(rng: np.random.Generator, h: int = 256, w: int = 256) -> Image:
    """Return a picture (h, w, 3) of a random kind, with the texture of paint or print."""
    image = _KINDS[rng.choice(4, p=[0.4, 0.3, 0.12, 0.18])](rng, h, w)
    return shade(image, (0.035, noise(rng, (h, w), 0.5)), (0.03, noise(rng, (h, w), 1.2)))
