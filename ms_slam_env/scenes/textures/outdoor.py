"""Streets and plants: asphalt, paving, lawn, roof tiles, panes, sky, bark, leaves, soil."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures.noise import Image, grain, hsv, noise, shade, write


def asphalt(rng: Rng, size: int = 1024) -> Image:
    """Grey tar with chippings, stains, cracks, mended patches and a few covers."""
    shape = (size, size)
    colour = np.full((*shape, 3), (112.0, 110, 110), np.float32)
    for _ in range(9):
        x, y = rng.integers(0, size, 2)
        w, h = rng.integers(size // 16, size // 4, 2)
        colour[y : y + h, x : x + w] *= rng.uniform(0.68, 1.2)
    for _ in range(3):
        at, r = tuple(rng.integers(size // 8, size, 2).tolist()), size // 22
        cv2.circle(colour, at, r, (70, 66, 62), -1, cv2.LINE_AA)
        cv2.circle(colour, at, r, (140, 134, 126), 3, cv2.LINE_AA)
        for k in range(-2, 3):
            a = (at[0] - r // 2, at[1] + k * r // 3)
            cv2.line(colour, a, (at[0] + r // 2, a[1]), (118, 112, 104), 3)
    cracks = np.exp(-np.abs(noise(rng, shape, 1.7)) * 70.0).astype(np.float32)
    return shade(
        colour, (0.17, noise(rng, shape, 0.15)), (0.09, noise(rng, shape, 1.2)), (-0.45, cracks)
    )


def paving(rng: Rng, count: int = 4, size: int = 512) -> Image:
    """Concrete slabs, ``count`` to a side, each of its own tone, with dark joints."""
    y, x = np.mgrid[:size, :size] * count / size
    row = y.astype(int)
    shifted = (x + 0.5 * (row % 2)) % count
    tone = 1.0 + 0.09 * rng.standard_normal((count, count)).clip(-2, 2)
    fy, fx = y - row, shifted % 1.0
    joint = np.minimum(np.minimum(fy, 1 - fy), np.minimum(fx, 1 - fx)) < 0.022
    colour = np.array([172.0, 166, 156]) * tone[row, shifted.astype(int)][..., None]
    colour = np.where(joint[..., None], np.array([92.0, 88, 82]), colour)
    shape = (size, size)
    return grain(rng, colour, shape, (0.05, 0.4), (0.06, 1.4))


def grass(rng: Rng, size: int = 512) -> Image:
    """Lawn with bare patches and clover."""
    shape = (size, size)
    blades, patches = noise(rng, shape, 0.5, 0.5), noise(rng, shape, 1.3)
    dry = np.clip(0.5 + 0.5 * patches, 0, 1)[..., None]
    colour = (1 - dry) * np.array([74.0, 104, 44]) + dry * np.array([112.0, 122, 62])
    return shade(colour, (0.26, blades), (0.10, noise(rng, shape, 1.0)))


def clump(rng: Rng, hue: float = 0.27, size: int = 256) -> Image:
    """Leaves over one another, light ones above dark ones; tiles."""
    image = np.full((size, size, 3), hsv(hue, 0.6, 0.16), np.float32)
    count = 900
    for k in range(count):
        x, y = rng.integers(0, size, 2)
        value = 0.20 + 0.42 * k / count * rng.uniform(0.6, 1.25)
        colour = hsv(hue + rng.uniform(-0.035, 0.035), rng.uniform(0.45, 0.72), min(value, 0.8))
        axes = (int(rng.integers(4, 10)), int(rng.integers(2, 6)))
        angle = float(rng.uniform(0, 180))
        for dx in (-size, 0, size):  # so that the image tiles
            for dy in (-size, 0, size):
                at = (int(x + dx), int(y + dy))
                if -12 < at[0] < size + 12 and -12 < at[1] < size + 12:
                    cv2.ellipse(image, at, axes, angle, 0, 360, colour.tolist(), -1)
    return grain(rng, image, (size, size), (0.06, 0.8))


def bark(rng: Rng, size: int = 256) -> Image:
    """Grey-brown bark with furrows along the rows' direction y."""
    furrows = noise(rng, (size, size), 0.9, 6.0).T
    return shade((104, 84, 66), (0.28, furrows), (0.08, noise(rng, (size, size), 0.5)))


def roof_tiles(rng: Rng, rgb: ArrayLike, size: int = 512) -> Image:
    """Overlapping courses of clay tiles, 12 to a side."""
    count = 12
    y, x = np.mgrid[:size, :size] * count / size
    row = y.astype(int)
    shifted = (x + 0.5 * (row % 2)) % count
    tone = 1.0 + 0.13 * rng.standard_normal((count, count)).clip(-2, 2)
    fy, fx = y - row, shifted % 1.0
    shadow = (
        1.0 - 0.5 * np.exp(-((1.0 - fy) / 0.12)) - 0.35 * np.exp(-np.minimum(fx, 1 - fx) / 0.06)
    )
    colour = np.asarray(rgb, float) * (tone[row, shifted.astype(int)] * shadow)[..., None]
    return grain(rng, colour, (size, size), (0.06, 0.8))


def siding(rng: Rng, rgb: ArrayLike, rows: int = 8, size: int = 512) -> Image:
    """Painted boards lying over one another, with knots and worn paint."""
    y = np.arange(size) * rows / size
    shadow = 1.0 - 0.4 * np.exp(-(1.0 - y % 1.0) / 0.05)
    tone = (1.0 + 0.04 * rng.standard_normal(rows))[y.astype(int)]
    shape = (size, size)
    colour = np.asarray(rgb, float) * (shadow * tone)[:, None, None] * np.ones((1, size, 1))
    return grain(rng, colour, shape, (0.05, 0.8, 12.0), (0.05, 1.4))


def pane(rng: Rng, frame_rgb: ArrayLike, bars: int = 1, size: int = 128) -> Image:
    """A window seen from the street: frame, bars, curtains, and the sky mirrored in the glass."""
    h = w = size
    top, low = hsv(0.58, 0.3, rng.uniform(0.55, 0.85)), hsv(0.6, 0.3, rng.uniform(0.14, 0.3))
    t = np.linspace(0, 1, h)[:, None, None] ** rng.uniform(0.5, 1.5)
    image = ((1 - t) * top + t * low) * np.ones((1, w, 1))
    image *= 1.0 + 0.08 * noise(rng, (h, w), 1.4)[..., None]
    if rng.random() < 0.6:  # curtains behind the glass
        cloth = hsv(rng.random(), rng.uniform(0.05, 0.35), rng.uniform(0.5, 0.85))
        wide = int(w * rng.uniform(0.14, 0.3))
        folds = 1.0 + 0.18 * np.sin(np.arange(wide) * 0.9)[None, :, None]
        image[:, :wide] = 0.25 * image[:, :wide] + 0.75 * cloth * folds
        image[:, w - wide :] = 0.25 * image[:, w - wide :] + 0.75 * cloth * folds[:, ::-1]
    elif rng.random() < 0.5:  # blinds
        image[: int(h * rng.uniform(0.3, 0.7)) : 6] *= 0.55
    edge = max(3, size // 16)
    frame = np.asarray(frame_rgb, float)
    image[:edge], image[-edge:], image[:, :edge], image[:, -edge:] = frame, frame, frame, frame
    for k in range(1, bars + 1):
        x = k * w // (bars + 1)
        image[:, x - edge // 2 : x + edge // 2 + 1] = frame
    y = int(0.36 * h)
    image[y - edge // 2 : y + edge // 2 + 1] = frame
    return np.clip(image, 0, 255).astype(np.uint8)


def panelled_door(rng: Rng, rgb: ArrayLike, size: int = 128) -> Image:
    """Front door with panels, a light on top and a handle."""
    image = np.full((2 * size, size, 3), np.asarray(rgb, float), np.float32)
    for top, low in ((0.08, 0.24), (0.3, 0.58), (0.64, 0.93)):
        for left in (0.12, 0.55):
            a, b = int(2 * size * top), int(2 * size * low)
            c, d = int(size * left), int(size * (left + 0.33))
            colour = hsv(0.58, 0.2, 0.55) if top < 0.1 else np.asarray(rgb, float) * 0.78
            image[a:b, c:d] = np.asarray(rgb, float) * 1.25
            image[a + 3 : b, c + 3 : d] = colour
    cv2.circle(image, (int(0.88 * size), int(1.1 * size)), 5, (205, 190, 130), -1)
    return grain(rng, image, (2 * size, size), (0.05, 0.9))


def sky(rng: Rng, h: int = 512, w: int = 1024) -> Image:
    """Sky (rows: zenith to horizon, columns all around) with fair-weather clouds."""
    up = np.linspace(1.0, 0.0, h)[:, None, None]
    zenith, horizon = np.array([92.0, 142, 208]), np.array([206.0, 222, 236])
    blue = horizon + (zenith - horizon) * up**0.7
    field = noise(rng, (h, w), 1.35, 2.0)
    cover = np.clip((field - 0.35) / 0.9, 0, 1)[..., None] * (1.0 - 0.5 * up)
    grey = 1.0 - 0.12 * np.clip(noise(rng, (h, w), 1.2), 0, 2)[..., None]
    image = blue + cover * (np.array([250.0, 249, 246]) * grey - blue)
    return np.clip(image, 0, 255).astype(np.uint8)


def boards(rng: Rng, rgb: ArrayLike, count: int = 12, size: int = 256) -> Image:
    """Upright fence boards with dark gaps."""
    x = np.arange(size) * count / size
    gap = (x % 1.0) < 0.09
    tone = (1.0 + 0.12 * rng.standard_normal(count))[x.astype(int)]
    row = np.where(gap, 0.25, tone)[None, :, None] * np.ones((size, 1, 1))
    grain = noise(rng, (size, size), 0.9, 10.0).T
    return shade(np.asarray(rgb, float) * row, (0.12, grain), (0.05, noise(rng, (size, size), 1.3)))


def road_sign(rng: Rng, text: str, rgb: ArrayLike, size: int = 128) -> Image:
    """A white-rimmed sign with some letters."""
    image = np.full((size // 2, size, 3), 240, np.float32)
    image[4:-4, 4:-4] = np.asarray(rgb, float)
    font = cv2.FONT_HERSHEY_DUPLEX
    scale = 0.9 * (size - 24) / max(1, cv2.getTextSize(text, font, 1.0, 2)[0][0])
    write(image, text, (12, int(0.36 * size)), (font, min(scale, 1.2), 2), 245, cv2.LINE_AA)
    return grain(rng, image, image.shape[:2], (0.03, 0.9))


def leaf(rng: Rng, size: int = 128) -> Image:
    """A leaf's surface, midrib along the rows in the middle column, side veins off it."""
    colour = hsv(rng.uniform(0.24, 0.36), rng.uniform(0.5, 0.75), rng.uniform(0.35, 0.55))
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    off = np.abs(x - 0.5)
    rib = np.exp(-((off / 0.02) ** 2))
    veins = np.exp(-(((((y + 0.8 * off) * 9.0) % 1.0 - 0.5) / 0.09) ** 2)) * (off < 0.46)
    image = grain(rng, colour, (size, size), (0.10, 1.2))
    light = (0.5 * rib + 0.22 * veins)[..., None]
    return np.clip(image + light * (np.array([205, 220, 150]) - image), 0, 255).astype(np.uint8)


def soil(rng: Rng, size: int = 128) -> Image:
    """Dark crumbly earth."""
    return grain(rng, (72, 52, 38), (size, size), (0.3, 0.5))
