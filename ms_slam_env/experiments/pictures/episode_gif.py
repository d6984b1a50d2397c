"""``python -m ms_slam_env.experiments.pictures.episode_gif``: an episode of a planner as a GIF."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import gymnasium
import imageio.v3 as iio
import numpy as np
from tqdm import tqdm

from ms_slam_env.env.planners import make_planner
from ms_slam_env.experiments.harness.episodes import DEFAULT_STEP_DEG, DEFAULT_STEP_M
from ms_slam_env.experiments.pictures.drawing import run_script
from ms_slam_env.output_files import write_bytes


@dataclass(frozen=True)
class Options:
    """Show an episode of a planner as a GIF."""

    out: Path = Path("docs/pictures/greedy.gif")
    planner: str = "greedy"
    scene: str = "living_room"
    scene_seed: int = 2003
    seed: int = 2003
    steps: int = 36
    step_m: float = DEFAULT_STEP_M
    step_deg: float = DEFAULT_STEP_DEG
    width: int = 640


def save_episode(options: Options) -> str:
    """Run the episode and write one picture a step."""
    env = gymnasium.make(
        "MSActiveSLAM-FreeCamera-v0",
        scene=options.scene,
        scene_seed=options.scene_seed,
        step_m=options.step_m,
        step_rad=float(np.deg2rad(options.step_deg)),
        render_mode="rgb_array",
    )
    observation, info = env.reset(seed=options.seed)
    planner = make_planner(options.planner, env.unwrapped, seed=options.seed)
    planner.reset()
    pictures = []
    for _ in tqdm(range(options.steps), desc=options.planner):
        observation, _, terminated, truncated, info = env.step(planner.act(observation, info))
        picture = np.asarray(env.render())
        height = round(picture.shape[0] * options.width / picture.shape[1])
        pictures.append(cv2.resize(picture, (options.width, height), interpolation=cv2.INTER_AREA))
        if terminated or truncated:
            break
    gif = iio.imwrite("<bytes>", np.stack(pictures), extension=".gif", duration=150, loop=0,
                      plugin="pillow")  # fmt: skip
    write_bytes(options.out, gif)
    return f"{len(pictures)} steps, ATE {1e3 * info['ate']:.1f} mm"


if __name__ == "__main__":
    sys.exit(run_script(Options, save_episode))
