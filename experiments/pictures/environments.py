"""The films of the gallery: `python -m ms_slam_experiments.pictures.environments`.

An episode of each id: as `render()` shows it, or what an imperfect camera takes.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

from ms_slam_experiments.pictures import film
from ms_slam_experiments.pictures.drawing import run_script

from ms_slam_env import ENV_IDS, PERTURBED_ENV_IDS
from ms_slam_env._runtime.output_files import check_out_folder
from ms_slam_env.errors import unknown

SHOWN_IDS = (*ENV_IDS, *(name for name in PERTURBED_ENV_IDS if "-FreeCamera-" in name))
"""An imperfect camera takes the same pictures whoever holds it."""

_PLANNERS = {"MSActiveSLAM-FixedTranslation-v0": "greedy", "MSActiveSLAM-Adaptive-v0": "random"}
_SCENES = {"MSActiveSLAM-v0": "table"}


@dataclass(frozen=True)
class Options:
    """Film an episode of each environment.

    Attributes:
        out: folder of the WebP files.
        ids: of the environments; by default all.
        steps: length of an episode.
        camera_steps: of one with an imperfect camera.
    """

    out: Path = Path("docs/pictures/environments")
    ids: tuple[str, ...] = ()
    steps: int = 40
    camera_steps: int = 24

    def __post_init__(self) -> None:
        """Refuse ids that have no film."""
        for env_id in self.ids:
            if env_id not in SHOWN_IDS:
                raise unknown("environment", env_id, SHOWN_IDS)


def film_of(env_id: str, options: Options) -> film.Options:
    """How the episode of an id is filmed."""
    plain = film.Options(
        out=options.out / f"{env_id}.webp",
        planner=_PLANNERS.get(env_id, "nbv"),
        env_id=env_id,
        view="moment",
        scene=_SCENES.get(env_id, "living_room"),
        steps=options.steps,
        every=2,
        width=640,
        picture_ms=300,
        most_kb=200,
    )
    if env_id in ENV_IDS:
        return plain
    camera = replace(plain, view="camera", steps=options.camera_steps, width=400, most_kb=170)
    return replace(camera, every=1, picture_ms=150)


def draw(options: Options) -> str:
    """Write the films; return what was done."""
    ids = options.ids or SHOWN_IDS
    for env_id in ids:
        print(f"{env_id}: {film.save_film(film_of(env_id, options))}")
    return f"{len(ids)} films"


if __name__ == "__main__":
    sys.exit(run_script(Options, draw, check_out=check_out_folder))
