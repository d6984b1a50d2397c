"""The picture of all scenes: `python -m ms_slam_env.benchmark.contact_sheet --out FILE.png`.

One row a scene (two seeds of some), three columns: colour, depth, normals, as an ideal sensor
sees them from the scene's own start poses.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import RGBDSensor

PROGRAM = "python -m ms_slam_env.benchmark.contact_sheet"
_ROWS: tuple[tuple[str, int], ...] = (
    ("living_room", 0),
    ("living_room", 1),
    ("corridor", 0),
    ("corridor", 1),
    ("window", 0),
    ("window", 1),
    ("table", 0),
    ("table", 1),
    ("wall", 0),
    ("wall", 1),
    ("carpet", 0),
    ("carpet", 1),
)
_FAR_M = 4.0
_CANDIDATES = 12
_BORDER = 4
_TITLE = 18

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Options:
    """Draw the contact sheet of all procedural scenes.

    Attributes:
        out: the PNG file to write.
        width: of one image, pixels.
    """

    out: Path = Path("docs/pictures/scenes.png")
    width: int = 200


def views(scene: Scene, intrinsics: Intrinsics) -> tuple[Image, Image, Image]:
    """Colour, depth and normals (H, W, 3) from the start pose that shows most objects."""
    sensor = RGBDSensor(scene, intrinsics, noise="none")
    rng = np.random.default_rng(scene.seed)
    seen = [sensor.ground_truth(scene.sample_start(rng)) for _ in range(_CANDIDATES)]
    view = max(seen, key=lambda v: len(np.unique(v.labels[::4, ::4])))
    near = 1.0 - np.clip(view.depth / _FAR_M, 0.0, 1.0)
    depth = matplotlib.colormaps["viridis"](near)[..., :3] * 255
    depth[view.depth == 0] = 0
    normals = np.where(view.normals.any(-1, keepdims=True), 0.5 - 0.5 * view.normals, 0.0) * 255
    return view.color, depth.astype(np.uint8), normals.astype(np.uint8)


def contact_sheet(width: int) -> Image:
    """Return the whole sheet, an RGB image; scenes side by side, two seeds a row."""
    intrinsics = xtion("640x480")
    height = width * 3 // 4
    strips = []
    for name, seed in _ROWS:
        images = [
            cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            for image in views(scenes.make(name, seed), intrinsics)
        ]
        framed = [
            cv2.copyMakeBorder(i, 0, _BORDER, 0, _BORDER, cv2.BORDER_CONSTANT, value=(255,) * 3)
            for i in images
        ]
        strip = np.concatenate(framed, 1)
        title = np.full((_TITLE, strip.shape[1], 3), 255, np.uint8)
        text = f"{name}, seed {seed}: colour, depth, normals"
        at = (2, _TITLE - 5)
        cv2.putText(title, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (30, 30, 30), 1, cv2.LINE_AA)
        strips.append(np.concatenate([title, strip], 0))
    pairs = [np.concatenate(strips[k : k + 2], 1) for k in range(0, len(strips), 2)]
    return np.concatenate(pairs, 0)


def main() -> int:
    """Write the sheet; return the exit code."""
    options = parse(Options, None, PROGRAM)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    sheet = contact_sheet(options.width)
    cv2.imwrite(str(options.out), sheet[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
