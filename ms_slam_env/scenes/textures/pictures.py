"""Pictures, prints and screens: paintings, book spines, covers, pages, displays."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures.noise import Image, grain, hsv, noise, write

_Canvas = NDArray[np.float32]


def _gradient(h: int, w: int, top: NDArray[np.float64], bottom: NDArray[np.float64]) -> _Canvas:
    t = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    return np.ascontiguousarray(
        np.broadcast_to((1 - t) * top + t * bottom, (h, w, 3)), dtype=np.float32
    )


def _landscape(rng: Rng, h: int, w: int) -> _Canvas:
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
        crown = hsv(rng.uniform(0.2, 0.38), 0.6, rng.uniform(0.2, 0.5)).tolist()
        cv2.ellipse(image, (x, y - int(1.4 * s)), (int(0.5 * s), s), 0, 0, 360, crown, -1)
    return image


def _abstract(rng: Rng, h: int, w: int) -> _Canvas:
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


def _portrait(rng: Rng, h: int, w: int) -> _Canvas:
    """Head and shoulders in front of a dark background."""
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


def _flowers(rng: Rng, h: int, w: int) -> _Canvas:
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
    middle, axes = (w // 2, int(0.82 * h)), (int(0.11 * w), int(0.15 * h))
    vase = hsv(hue + 0.5, 0.4, 0.5).tolist()
    cv2.ellipse(image, middle, axes, 0, 0, 360, vase, -1, cv2.LINE_AA)
    return image


_KINDS = (_landscape, _abstract, _portrait, _flowers)


def picture(rng: Rng, h: int = 256, w: int = 256) -> Image:
    """Return a picture (h, w, 3) of a random kind, with the texture of paint or print."""
    image = _KINDS[rng.choice(4, p=[0.4, 0.3, 0.12, 0.18])](rng, h, w)
    return grain(rng, image, (h, w), (0.035, 0.5), (0.03, 1.2))


_LETTERS = "ABCDEFGHIKLMNOPRSTUVWY"
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX)

SPINE_SLOTS = 16
"""Number of spines side by side in one image of ``spines``."""


def _word(rng: Rng, low: int = 3, high: int = 10) -> str:
    return "".join(_LETTERS[k] for k in rng.integers(0, len(_LETTERS), rng.integers(low, high)))


def _text(
    image: NDArray[np.generic],
    text: str,
    at: tuple[int, int],
    height: int,
    colour: NDArray[np.float64],
    font: int,
) -> None:
    style = (font, height / 22.0, max(1, height // 10))
    write(image, text, at, style, colour, cv2.LINE_AA)


def book_colour(rng: Rng) -> NDArray[np.float64]:
    """Return the colour of a binding: many muted, some bright, some near black or white."""
    kind = rng.random()
    if kind < 0.2:
        return hsv(0.1, rng.uniform(0.02, 0.15), rng.uniform(0.8, 0.97))
    if kind < 0.35:
        return hsv(rng.random(), 0.3, rng.uniform(0.08, 0.2))
    hue = rng.choice([0.0, 0.02, 0.05, 0.09, 0.13, 0.35, 0.5, 0.58, 0.62])
    return hsv(hue + rng.uniform(-0.02, 0.02), rng.uniform(0.3, 0.85), rng.uniform(0.25, 0.8))


def spines(rng: Rng, size: tuple[int, int] = (256, 512)) -> Image:
    """Return ``SPINE_SLOTS`` book spines side by side (h, w, 3): title, bands, publisher's mark."""
    h, w = size
    slot = w // SPINE_SLOTS
    sheet = np.zeros((h, w, 3), np.float32)
    for k in range(SPINE_SLOTS):
        ground = book_colour(rng)
        ink = np.array([235.0, 225, 195]) if ground.mean() < 130 else np.array([35.0, 30, 40])
        spine = np.broadcast_to(ground, (slot, h, 3)).astype(np.float32).copy()  # lying on its side
        for _ in range(int(rng.integers(0, 4))):
            x, wide = int(rng.uniform(0, h)), int(rng.uniform(2, 18))
            spine[:, x : x + wide] = ink if rng.random() < 0.6 else book_colour(rng)
        if rng.random() < 0.3:
            x = int(rng.uniform(0.1, 0.5) * h)
            spine[:, x : x + h // 4] = book_colour(rng)
        title = f"{_word(rng)} {_word(rng)}"
        at = (int(rng.uniform(0.06, 0.3) * h), int(0.68 * slot))
        _text(spine, title, at, int(slot * rng.uniform(0.35, 0.6)), ink, _FONTS[rng.integers(3)])
        cv2.circle(spine, (int(0.93 * h), slot // 2), slot // 5, ink.tolist(), -1, cv2.LINE_AA)
        rounded = 1.0 - 0.35 * np.abs(np.linspace(-1, 1, slot, dtype=np.float32)) ** 3
        sheet[:, k * slot : (k + 1) * slot] = np.rot90(spine * rounded[:, None, None], -1)
    return grain(rng, sheet, (h, w), (0.04, 0.8))


def cover(rng: Rng, h: int = 256, w: int = 256) -> Image:
    """Front of a book or magazine: a picture under a title."""
    image = picture(rng, h, w).astype(np.float32)
    band = int(rng.uniform(0.12, 0.25) * h)
    ground = book_colour(rng)
    image[:band] = ground
    ink = np.array([245.0, 240, 230]) if ground.mean() < 130 else np.array([25.0, 25, 30])
    _text(image, _word(rng, 4, 8), (w // 12, int(0.75 * band)), int(0.6 * band), ink, _FONTS[1])
    for k in range(int(rng.integers(1, 5))):
        y = int(h * (0.62 + 0.08 * k))
        _text(image, f"{_word(rng)} {_word(rng)}", (w // 12, y), h // 22, ink, _FONTS[0])
    return np.clip(image, 0, 255).astype(np.uint8)


def page(rng: Rng, h: int = 256, w: int = 256) -> Image:
    """Paper with a heading, lines of text and a figure."""
    image = np.full((h, w, 3), (238, 235, 226), np.float32)
    _text(image, _word(rng, 6, 10), (w // 10, h // 8), h // 14, np.array([30.0, 30, 35]), _FONTS[1])
    y = h // 6
    while y < 0.93 * h:
        y += h // 36
        if rng.random() < 0.06 and y < 0.65 * h:
            fh, fw = h // 5, w // 2
            x = int(rng.uniform(0.1, 0.4) * w)
            image[y : y + fh, x : x + fw] = cv2.resize(picture(rng, 128, 128), (fw, fh))
            y += fh + h // 30
            continue
        end = w * (0.9 if rng.random() < 0.85 else rng.uniform(0.3, 0.8))
        x = w // 10
        while x < end - 4:
            length = int(rng.uniform(0.02, 0.1) * w)
            cv2.line(image, (x, y), (int(min(x + length, end)), y), (70, 68, 72), max(1, h // 130))
            x += length + w // 60
    return np.clip(image, 0, 255).astype(np.uint8)


def screen(rng: Rng, h: int = 256, w: int = 512) -> Image:
    """A desktop: wallpaper picture, windows with text and plots."""
    image = picture(rng, h, w)
    for _ in range(int(rng.integers(1, 4))):
        wh, ww = int(rng.uniform(0.35, 0.75) * h), int(rng.uniform(0.25, 0.5) * w)
        y, x = int(rng.uniform(0.04, 0.95) * (h - wh)), int(rng.uniform(0, 1) * (w - ww))
        dark = rng.random() < 0.5
        image[y : y + wh, x : x + ww] = (36, 38, 46) if dark else (240, 241, 244)
        image[y : y + h // 22, x : x + ww] = hsv(rng.random(), 0.4, 0.6).astype(np.uint8)
        row = y + h // 12
        while row < y + wh - 6:
            at = x + int(rng.integers(1, 6)) * w // 90 + 4
            for _ in range(int(rng.integers(1, 6))):
                length = int(rng.uniform(0.015, 0.09) * w)
                if at + length > x + ww - 4:
                    break
                colour = hsv(rng.random(), 0.5, 0.9 if dark else 0.45)
                cv2.line(image, (at, row), (at + length, row), colour.tolist(), 2)
                at += length + w // 100
            row += h // 32
    image[-h // 20 :] = (28, 30, 36)
    return image


def television(rng: Rng) -> Image:
    """A film frame: a picture with letter-box bars."""
    image = picture(rng, 256, 512)
    image[:18], image[-18:] = 4, 4
    return image
