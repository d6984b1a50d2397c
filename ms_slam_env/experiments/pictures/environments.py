"""The pictures of the gallery: `python -m ms_slam_env.experiments.pictures.environments`.

What `render()` shows of each id after some random motions.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np

from ms_slam_env import ENV_IDS
from ms_slam_env.experiments.pictures.drawing import Image, run_script, save_image
from ms_slam_env.output_files import check_out_folder


@dataclass(frozen=True)
class Options:
    """Draw a moment of an episode of each environment.

    Attributes:
        out: folder of the PNG files.
        steps: random motions before that moment.
        scene: where.
        width: of a picture, pixels.
    """

    out: Path = Path("docs/pictures/environments")
    steps: int = 12
    scene: str = "living_room"
    width: int = 840


def moment(env_id: str, options: Options) -> Image:
    """The picture of one environment, (H, width, 3) RGB."""
    env = gym.make(env_id, scene=options.scene, scene_seed=0, render_mode="rgb_array")
    _, info = env.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(options.steps):
        motions = info["action_mask"][: 7 if "FixedTranslation" in env_id else 49]
        motion = rng.choice(np.flatnonzero(motions))
        action = np.array([motion, 2]) if "Adaptive" in env_id else motion
        *_, info = env.step(action)
    picture = np.asarray(env.render(), dtype=np.uint8)
    height = round(picture.shape[0] * options.width / picture.shape[1])
    shrunk = cv2.resize(picture, (options.width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk, dtype=np.uint8)


def draw(options: Options) -> str:
    """Write the pictures; return what was done."""
    for env_id in ENV_IDS:
        save_image(options.out / f"{env_id}.png", moment(env_id, options))
    return f"{len(ENV_IDS)} pictures"


if __name__ == "__main__":
    sys.exit(run_script(Options, draw, check_out=check_out_folder))
