"""Printed and lit things: book spines, covers, screens, cardboard labels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.textures.noise import Image, hsv, noise, shade
from ms_slam_env.scenes.textures.pictures import picture

_LETTERS = "ABCDEFGHIKLMNOPRSTUVWY"
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX)

SPINE_SLOTS = 16
"""Spines side by side in one image of ``spines``."""


def _word(rng: np.random.Generator, low: int = 3, high: int = 10) -> str:
    return "".join(_LETTERS[k] for k in rng.integers(0, len(_LETTERS), rng.integers(low, high)))


def _text(
    image: NDArray[np.generic],
    text: str,
    at: tuple[int, int],
    height: int,
    colour: NDArray[np.float64],
    font: int,
) -> None:
    mask = np.zeros(image.shape[:2], np.uint8)  # text is drawn on 8 bits only
    thickness = max(1, height // 10)
    cv2.putText(mask, text, at, font, height / 22.0, 255, thickness, cv2.LINE_AA)
    image[mask > 96] = colour


def book_colour(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the colour of a binding: many muted, some bright, some near black or white."""
    kind = rng.random()
    if kind < 0.2:
        return hsv(0.1, rng.uniform(0.02, 0.15), rng.uniform(0.8, 0.97))
    if kind < 0.35:
        return hsv(rng.random(), 0.3, rng.uniform(0.08, 0.2))
    hue = rng.choice([0.0, 0.02, 0.05, 0.09, 0.13, 0.35, 0.5, 0.58, 0.62])
    return hsv(hue + rng.uniform(-0.02, 0.02), rng.uniform(0.3, 0.85), rng.uniform(0.25, 0.8))


def spines(rng: np.random.Generator, size: tuple[int, int] = (256, 512)) -> Image:
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
        _text(
            spine,
            title,
            (int(rng.uniform(0.06, 0.3) * h), int(0.68 * slot)),
            int(slot * rng.uniform(0.35, 0.6)),
            ink,
            _FONTS[rng.integers(3)],
        )
        cv2.circle(spine, (int(0.93 * h), slot // 2), slot // 5, ink.tolist(), -1, cv2.LINE_AA)
        rounded = 1.0 - 0.35 * np.abs(np.linspace(-1, 1, slot, dtype=np.float32)) ** 3
        sheet[:, k * slot : (k + 1) * slot] = np.rot90(spine * rounded[:, None, None], -1)
    return shade(sheet, (0.04, noise(rng, (h, w), 0.8)))


def cover(rng: np.random.Generator, h: int = 256, w: int = 256) -> Image:
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


def page(rng: np.random.Generator, h: int = 256, w: int = 256) -> Image:
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


def screen(rng: np.random.Generator, h: int = 256, w: int = 512) -> Image:
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


def television(rng: np.random.Generator) -> Image:
    """A frame of some film: a picture with letter-box bars."""
    image = picture(rng, 256, 512)
    image[:18], image[-18:] = 4, 4
    return image
