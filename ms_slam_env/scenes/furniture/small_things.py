"""Small objects on tables and shelves, and screens."""

from __future__ import annotations

import cv2
import numpy as np

from ms_slam_env.scenes.builder import Material, MeshBuilder
from ms_slam_env.scenes.scene import Rng
from ms_slam_env.scenes.textures import interior, pictures
from ms_slam_env.scenes.textures.noise import Image, grain, hsv
from ms_slam_env.scenes.textures.pictures import picture


def glaze(build: MeshBuilder, rng: Rng, banded: bool = True) -> Material:
    """Ceramic: one colour with painted bands around, and fine speckles."""
    h, w = 128, 256
    base = hsv(rng.random(), rng.uniform(0.05, 0.7), rng.uniform(0.5, 0.95))
    image = np.broadcast_to(base, (h, w, 3)).astype(np.float32).copy()
    if banded:
        accent = hsv(rng.random(), 0.6, rng.uniform(0.2, 0.8))
        for _ in range(int(rng.integers(1, 4))):
            y = int(rng.uniform(0.1, 0.85) * h)
            image[y : y + int(rng.uniform(3, 14))] = accent
        if rng.random() < 0.6:
            y, step = int(rng.uniform(0.3, 0.6) * h), int(rng.integers(12, 32))
            for x in range(0, w, step):
                image[y : y + step // 2, x : x + step // 2] = accent
    return build.material(grain(rng, image, (h, w), (0.04, 0.6)))


def wood(build: MeshBuilder, rng: Rng, tile_m: tuple[float, float], size: int = 512) -> Material:
    """Wooden board, one image of ``size`` pixels over ``tile_m``."""
    return build.material(
        build.stocked(rng, f"board {size}", lambda: interior.board(rng, size=size)), tile_m
    )


def cup(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Mug with a handle and coffee, standing at the origin."""
    r, h = rng.uniform(0.035, 0.045), rng.uniform(0.08, 0.11)
    outside = [(0.85 * r, 0), (r, 0.02), (r, 0.6 * h), (r, h), (r, h)]
    inside = [(0.88 * r, h), (0.88 * r, h), (0.88 * r, 0.7 * h)]
    with build.object(name):
        material = glaze(build, rng)
        build.lathe(outside + inside, material)
        build.lathe([(0.88 * r, 0.7 * h), (0, 0.7 * h)], build.plain((58, 36, 24)), 16)
        angle = np.linspace(-1.4, 1.4, 9)
        path = np.stack([r + 0.026 * np.cos(angle), 0 * angle, 0.5 * h + 0.03 * np.sin(angle)], -1)
        around = np.linspace(0, 2 * np.pi, 9)
        radial = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
        side = np.array([0.0, 1.0, 0.0])
        tube = path[:, None] + 0.006 * (
            np.cos(around)[None, :, None] * radial[:, None] + np.sin(around)[None, :, None] * side
        )
        build.patch(tube, material, inset=False)


def plate(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Plate with a decorated rim; sometimes fruit on it."""
    r = rng.uniform(0.1, 0.14)
    with build.object(name):
        profile = [(0.6 * r, 0), (r, 0.02), (r, 0.024), (0.66 * r, 0.012), (0, 0.012)]
        build.lathe(profile, glaze(build, rng), 32)
    if rng.random() < 0.6:
        fruit(build, rng, f"{name} fruit", 0.012)


def fruit(build: MeshBuilder, rng: Rng, name: str, z: float) -> None:
    """A few apples or oranges."""
    size = (64, 64)
    with build.object(name):
        for k in range(int(rng.integers(2, 5))):
            colour = hsv(rng.choice([0.0, 0.07, 0.14, 0.25]), rng.uniform(0.65, 0.9), 0.8)
            skin = build.material(grain(rng, colour, size, (0.09, 1.2)), (0.1, 0.1))
            angle, r = 2.1 * k + rng.uniform(0, 0.3), rng.uniform(0.03, 0.038)
            x, y = 0.045 * np.cos(angle), 0.045 * np.sin(angle)
            build.pillow((x - r, y - r, z), (x + r, y + r, z + 1.9 * r), skin, 1.0)


def bowl(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Bowl full of fruit."""
    r = rng.uniform(0.11, 0.15)
    outside = [(0.45 * r, 0), (0.8 * r, 0.035), (r, 0.085), (r, 0.085)]
    inside = [(0.95 * r, 0.085), (0.95 * r, 0.085), (0.75 * r, 0.045), (0, 0.035)]
    with build.object(name):
        build.lathe(outside + inside, glaze(build, rng), 28)
    fruit(build, rng, f"{name} fruit", 0.05)


def bottle(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Wine bottle or jar with a printed label."""
    r, h = rng.uniform(0.033, 0.042), rng.uniform(0.24, 0.31)
    glass = build.plain(hsv(rng.choice([0.3, 0.1, 0.55]), 0.6, rng.uniform(0.15, 0.4)))
    with build.object(name):
        body = [(0, 0), (r, 0), (r, 0), (r, 0.6 * h), (0.75 * r, 0.68 * h)]
        neck = [(0.36 * r, 0.75 * h), (0.36 * r, h), (0.36 * r, h), (0, h)]
        build.lathe(body + neck, glass, 18)
        printed_label = build.material(pictures.cover(rng, 128, 256))
        build.lathe([(1.02 * r, 0.15 * h), (1.02 * r, 0.45 * h)], printed_label, 18)


def vase(build: MeshBuilder, rng: Rng, height_m: float, name: str) -> None:
    """Turned vase of random outline."""
    t = np.linspace(0, 1, 9)
    wave = rng.uniform(0.6, 1.0) + 0.35 * np.sin(rng.uniform(2.5, 4.5) * t + rng.uniform(0, 2))
    r = height_m * 0.32 * np.clip(wave, 0.3, 1.2)
    outside = np.stack([r, t * height_m], -1)
    inside = [(0.8 * r[-1], height_m), (0.8 * r[-1], 0.8 * height_m), (0, 0.75 * height_m)]
    with build.object(name):
        build.lathe(np.concatenate([outside, inside]), glaze(build, rng), 22)


def ornament(build: MeshBuilder, rng: Rng, height_m: float, half_width_m: float, name: str) -> None:
    """A vase, a framed photograph or a ball, within the given size, in front of y = 0."""
    kind = rng.integers(3)
    size = float(min(height_m, 2.4 * half_width_m))
    if kind == 0:
        with build.frame((0, -0.13, 0)):
            vase(build, rng, size, name)
    elif kind == 1:
        w, h = min(half_width_m * 1.7, 0.2), size
        with build.object(name), build.frame((0, -0.06, 0), pitch=-0.2):
            border = build.plain(hsv(rng.random(), 0.3, rng.uniform(0.1, 0.9)))
            build.box((-w / 2, 0, 0), (w / 2, 0.015, h), border)
            b = 0.1 * w
            photo = build.material(picture(rng, 128, 128))
            build.quad((-w / 2 + b, -0.001, b), (w - 2 * b, 0, 0), (0, 0, h - 2 * b), photo)
    else:
        r = 0.4 * size
        with build.object(name):
            marble = interior.tiles(rng, hsv(rng.random(), 0.3, 0.8), 2, 128)
            build.pillow(
                (-r, -0.13 - r, 0), (r, -0.13 + r, 2 * r), build.material(marble, (0.2, 0.2)), 1.0
            )


def lying_book(build: MeshBuilder, rng: Rng, name: str, thick_m: float) -> None:
    """Book or magazine lying on its back, cover up, centred on the origin."""
    w, h = rng.uniform(0.13, 0.22), rng.uniform(0.19, 0.29)
    cover = build.material(pictures.cover(rng, 256, 256))
    pages = build.plain((228, 222, 205))
    with build.object(name), build.frame((0, 0, 0), yaw=rng.uniform(-np.pi, np.pi)):
        build.box((-w / 2, -h / 2, 0), (w / 2, h / 2, thick_m), pages, "z", top=cover)


def paper(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Printed sheet of paper, centred on the origin."""
    sheet = build.material(pictures.page(rng, 256, 192))
    with build.object(name), build.frame((0, 0, 0.0015), yaw=rng.uniform(-0.5, 0.5)):
        build.quad((-0.105, -0.148, 0), (0.21, 0, 0), (0, 0.297, 0), sheet)


def pen_pot(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Pot with pens and brushes."""
    with build.object(name):
        outside = [(0.04, 0), (0.04, 0.1), (0.04, 0.1)]
        inside = [(0.036, 0.1), (0.036, 0.1), (0.036, 0.03), (0, 0.03)]
        build.lathe(outside + inside, glaze(build, rng), 18)
        for k in range(int(rng.integers(4, 9))):
            ink = build.plain(hsv(rng.random(), 0.8, 0.7))
            angle, lean = 2.4 * k, rng.uniform(0.05, 0.25)
            with build.frame(
                (0.02 * np.cos(angle), 0.02 * np.sin(angle), 0.03), yaw=angle - 1.57, pitch=-lean
            ):
                build.lathe([(0.004, 0), (0.004, 0.15), (0.0, 0.162)], ink, 6)


def television(build: MeshBuilder, rng: Rng, width_m: float) -> None:
    """Flat television on a foot; its picture has the label "TV screen"."""
    black = build.plain((24, 24, 26))
    h, half = 0.57 * width_m, width_m / 2
    with build.object("TV"):
        build.box((-0.25, -0.28, 0), (0.25, -0.06, 0.015), black, "z")
        build.box((-0.05, -0.18, 0.015), (0.05, -0.14, 0.08), black)
        build.box((-half, -0.19, 0.07), (half, -0.14, 0.07 + h), black)
    with build.object("TV screen"):
        film = build.material(pictures.television(rng))
        build.quad((-half + 0.015, -0.192, 0.09), (width_m - 0.03, 0, 0), (0, 0, h - 0.04), film)


def keys(rng: Rng) -> Image:
    """Seen from above: rows of keys with a letter each."""
    image = np.full((128, 320, 3), 38, np.uint8)
    for row in range(5):
        x = 6 + 6 * row % 15
        while x < 300:
            wide = 20 if rng.random() < 0.85 else 40
            cv2.rectangle(
                image, (x, 6 + 24 * row), (min(x + wide - 4, 312), 25 + 24 * row), (72, 72, 76), -1
            )
            cv2.circle(image, (x + 6, 14 + 24 * row), 2, (225, 225, 225), -1)
            x += wide
    return image


def laptop(build: MeshBuilder, rng: Rng, name: str) -> None:
    """Open laptop; its picture has the label "<name> screen"."""
    silver = build.plain((150, 152, 156))
    with build.object(name):
        build.box((-0.165, -0.23, 0), (0.165, 0, 0.016), silver, "z")
        build.quad((-0.15, -0.16, 0.0165), (0.3, 0, 0), (0, 0.14, 0), build.material(keys(rng)))
        build.quad(
            (-0.045, -0.22, 0.0165), (0.09, 0, 0), (0, 0.05, 0), build.plain((120, 122, 126))
        )
    with build.frame((0, 0, 0.012), pitch=-0.3):
        with build.object(name):
            build.box((-0.165, -0.004, 0), (0.165, 0.004, 0.225), silver)
        with build.object(f"{name} screen"):
            desktop = build.material(pictures.screen(rng))
            build.quad((-0.155, -0.0045, 0.012), (0.31, 0, 0), (0, 0, 0.2), desktop)
