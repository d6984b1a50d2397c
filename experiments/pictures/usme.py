"""Two frames of each of the eight sequences of USME: `python -m ms_slam_experiments.pictures.usme`.

One above the other.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from ms_slam_experiments.pictures.drawing import Image, run_script

from ms_slam_env import scenes
from ms_slam_env.sequences.usme_suite import SUITE, render

_BORDER, _TITLE, _COLUMNS = 4, 20, 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True)
class Options:
    """Draw two frames of each of the eight sequences.

    Attributes:
        out: the file to write.
        seed: of scenes, ways, noise and perturbations.
    """

    out: Path = Path("docs/pictures/usme.webp")
    seed: int = 2000


def draw(options: Options) -> Image:
    """The picture."""
    made: dict[str, scenes.Scene] = {}
    tiles = []
    for entry in SUITE:
        if entry.scene not in made:
            made[entry.scene] = scenes.make(entry.scene, options.seed)
        sequence = render(entry, made[entry.scene], "320x240")
        count = len(sequence)
        shown = [sequence.frames[k].color for k in (count // 3, int(0.52 * count))]
        tiles.append(_tile(entry.name, shown))
    rows = [np.concatenate(tiles[k : k + _COLUMNS], 1) for k in range(0, len(tiles), _COLUMNS)]
    return np.concatenate(rows, 0)[..., ::-1]


def _tile(name: str, images: Sequence[Image]) -> Image:
    h, w = images[0].shape[:2]
    tile = np.full((_TITLE + len(images) * (h + _BORDER), w + _BORDER, 3), 255, np.uint8)
    cv2.putText(tile, name, (4, 14), _FONT, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    for k, image in enumerate(images):
        top = _TITLE + k * (h + _BORDER)
        tile[top : top + h, :w] = image[:, :, ::-1]
    return tile


if __name__ == "__main__":
    sys.exit(run_script(Options, draw))
