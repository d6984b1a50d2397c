"""``python -m ms_slam_experiments.pictures.film``: an episode of a planner as a moving picture.

Without options, the picture on top of the README: a planner explores a home.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import gymnasium
import numpy as np
from ms_slam_experiments.pictures.drawing import Image, run_script
from ms_slam_experiments.pictures.episode_views import VIEWS
from PIL import Image as Pillow

from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.config import Checked, bounded, chosen, free_options
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.planners import make_planner, planner_observation
from ms_slam_env.errors import InputError

_FORMATS = (".webp", ".gif")
_QUALITIES = (80, 65, 50, 40, 30, 20)  # of WebP, tried until the file is small enough
_LAST_MS = 2500  # how long the end is shown


@dataclass(frozen=True)
class Options(Checked):
    """Show an episode of a planner as an animated WebP or GIF."""

    out: Path = Path("docs/pictures/home.webp")
    """File to write, .webp or .gif."""
    planner: str = "nbv"
    """NAME or module:Class, options appended as in agent-room,deterministic=true."""
    env_id: str = "MSActiveSLAM-Home-v0"
    """Id of the environment or task."""
    view: str = chosen("exploration", *VIEWS)
    """exploration: the map from one place, and the space known; moment: what render() draws;
    camera: its colour and depth images."""
    scene: str | None = None
    """By default the id's own."""
    scene_seed: int = bounded(2000, 0, 2**31)
    """Of the scene."""
    seed: int = bounded(2000, 0, 2**31)
    """Of start pose, noise and planner."""
    steps: int = bounded(300, 1, 100_000)
    """Length of the episode; it may end before."""
    every: int = bounded(5, 1, 1000)
    """Steps from picture to picture."""
    options: tuple[str, ...] = ()
    """Further options of the environment, as name=value."""
    width: int = bounded(800, 64, 4096)
    """Of the picture, pixels."""
    picture_ms: int = bounded(150, 20, 10_000)
    """How long each picture is shown."""
    most_kb: int = bounded(1200, 10, 100_000)
    """Size that the file is kept below, by the quality of a WebP."""

    def __post_init__(self) -> None:
        """Refuse values out of range and other formats."""
        super().__post_init__()
        if self.out.suffix not in _FORMATS:
            raise InputError(f"{self.out} is neither {' nor '.join(_FORMATS)}")


def save_film(options: Options) -> str:
    """Play the episode and write the file; return what came of it."""
    scene: dict[str, Any] = {} if options.scene is None else {"scene": options.scene}
    env = gymnasium.make(
        options.env_id,
        max_episode_steps=options.steps,
        scene_seed=options.scene_seed,
        render_mode="rgb_array",
        observation=planner_observation(options.planner),
        **scene,
        **free_options(options.options, ("scene", "scene_seed", "observation", "render_mode")),
    )
    try:
        pictures = [narrowed(picture, options.width) for picture in play(env, options)]
        ate_m = cast(ActiveSlamEnv, env.unwrapped).episode.ate
    finally:
        env.close()
    data = encoded(pictures, options)
    write_bytes(options.out, data)
    return f"{len(pictures)} pictures, {len(data) / 1000:.0f} kB, ATE {1e3 * ate_m:.1f} mm"


def play(env: gymnasium.Env[Any, Any], options: Options) -> Iterator[Image]:
    """Pictures of the start, of every so many steps and of the end."""
    world = cast(ActiveSlamEnv, env.unwrapped)
    observation, info = env.reset(seed=options.seed)
    planner = make_planner(options.planner, world, seed=options.seed)
    planner.reset()
    view = VIEWS[options.view](world, planner)
    yield view.draw()
    for step in Bar(range(1, options.steps + 1), options.planner, unit="step"):
        action = planner.act(observation, planner.known(info))
        observation, _, terminated, truncated, info = env.step(action)
        view.see()
        is_over = terminated or truncated
        if is_over or step % options.every == 0:
            yield view.draw()
        if is_over:
            return


def narrowed(picture: Image, width: int) -> Image:
    """A picture (H, W, 3) at another width."""
    height = round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def encoded(pictures: Sequence[Image], options: Options) -> bytes:
    """The film as the content of a file, as good as its size allows.

    Raises:
        InputError: it is too large at every quality.
    """
    first, *rest = map(Pillow.fromarray, pictures)
    pauses = [*[options.picture_ms] * len(rest), _LAST_MS]
    kind = options.out.suffix[1:]
    for quality in _QUALITIES if kind == "webp" else _QUALITIES[:1]:
        file = io.BytesIO()
        first.save(file, kind, save_all=True, append_images=rest, duration=pauses, loop=0,
                   quality=quality, method=4)  # fmt: skip
        if file.tell() <= 1000 * options.most_kb:
            return file.getvalue()
    size = f"{file.tell() / 1000:.0f} kB"
    raise InputError(f"{options.out} would have {size}: take fewer steps, --every or --width")


if __name__ == "__main__":
    sys.exit(run_script(Options, save_film))
