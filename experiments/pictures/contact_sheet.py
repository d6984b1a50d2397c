"""The picture of all scenes: `python -m ms_slam_experiments.pictures.contact_sheet`.

One row a scene (two seeds of each), three columns: colour, depth, normals, as an ideal sensor
sees them from the scene's own start poses.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from ms_slam_experiments.pictures.drawing import Image, run_script, shrunk, titled_row

from ms_slam_env import scenes
from ms_slam_env.camera import Intrinsics, xtion
from ms_slam_env.scenes import Scene
from ms_slam_env.sensor import RGBDSensor

_SCENES = ("living_room", "corridor", "window", "table", "wall", "carpet")
_FAR_M = 4.0
_CANDIDATES = 12


@dataclass(frozen=True)
class Options:
    """Draw the contact sheet of all procedural scenes.

    Attributes:
        out: the file to write.
        width: of one image, pixels.
    """

    out: Path = Path("docs/pictures/scenes.webp")
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


def contact_sheet(options: Options) -> Image:
    """The whole sheet, an RGB image; two seeds of a scene side by side."""
    intrinsics = xtion("640x480")

    def row(name: str, seed: int) -> Image:
        images = views(scenes.make(name, seed), intrinsics)
        small = [shrunk(image, options.width) for image in images]
        return titled_row(small, f"{name}, seed {seed}: colour, depth, normals")

    return np.concatenate([np.concatenate([row(name, k) for k in (0, 1)], 1) for name in _SCENES])


if __name__ == "__main__":
    sys.exit(run_script(Options, contact_sheet))
