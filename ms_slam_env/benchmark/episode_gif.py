"""``python -m ms_slam_env.benchmark.episode_gif``: an episode of a planner as a GIF."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import gymnasium
import imageio.v3 as iio
import numpy as np
from tqdm import tqdm

from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.env.planners import make_planner
from ms_slam_env.experiments.harness.episodes import DEFAULT_STEP_DEG, DEFAULT_STEP_M

PROGRAM = "python -m ms_slam_env.benchmark.episode_gif"


@dataclass(frozen=True)
class Args:
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


def main() -> int:
    """Run the episode and write one picture a step; return the exit code."""
    args = parse(Args, None, PROGRAM)
    env = gymnasium.make(
        "MSActiveSLAM-FreeCamera-v0",
        scene=args.scene,
        scene_seed=args.scene_seed,
        step_m=args.step_m,
        step_rad=float(np.deg2rad(args.step_deg)),
        render_mode="rgb_array",
    )
    observation, info = env.reset(seed=args.seed)
    planner = make_planner(args.planner, env.unwrapped, seed=args.seed)
    planner.reset()
    pictures = []
    for _ in tqdm(range(args.steps), desc=args.planner):
        observation, _, terminated, truncated, info = env.step(planner.act(observation, info))
        picture = np.asarray(env.render())
        height = round(picture.shape[0] * args.width / picture.shape[1])
        pictures.append(cv2.resize(picture, (args.width, height), interpolation=cv2.INTER_AREA))
        if terminated or truncated:
            break
    args.out.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(args.out, np.stack(pictures), duration=150, loop=0, plugin="pillow")
    print(f"{args.out}: {len(pictures)} steps, ATE {1e3 * info['ate']:.1f} mm")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
