"""``python -m ms_slam_experiments.pictures.lookahead``: Fig. 7 of Saeedi et al., ICRA 2017.

The 49 predicted images of one moment with their divergences from the reference.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from ms_slam_experiments.pictures.drawing import run_script

from ms_slam_env.report.figures import save
from ms_slam_env.robot import NUM_ROTATIONS, NUM_TRANSLATIONS, ROTATIONS, TRANSLATIONS


@dataclass(frozen=True)
class Options:
    """Draw the 49 predicted images of one moment with their divergences."""

    out: Path = Path("docs/pictures/lookahead.png")
    scene: str = "living_room"
    scene_seed: int = 2000
    seed: int = 2000
    steps_before: int = 20


def save_lookahead(options: Options) -> str:
    """Move at random for a while, predict the 49 candidates and draw them."""
    env = gymnasium.make(
        "MSActiveSLAM-FreeCamera-v0", scene=options.scene, scene_seed=options.scene_seed
    )
    _, info = env.reset(seed=options.seed)
    rng = np.random.default_rng(options.seed)
    for _ in range(options.steps_before):
        _, _, _, _, info = env.step(rng.choice(np.flatnonzero(info["action_mask"])))
    active = env.unwrapped
    views, divergences = active.predict_candidates(), active.lookahead()  # type: ignore[attr-defined]
    figure = Figure(figsize=(14, 11.5))
    axes = figure.subplots(NUM_TRANSLATIONS, NUM_ROTATIONS)
    scale, colours = Normalize(0, divergences[:, 0].max()), matplotlib.colormaps["plasma"]
    corner = (0, 0), views.intrinsics.width * 0.16, views.intrinsics.height * 0.2
    for action, axis in enumerate(axes.ravel()):
        axis.imshow(views.intensity[action], cmap="gray", vmin=0, vmax=255)
        axis.add_patch(Rectangle(*corner, color=colours(scale(divergences[action, 0]))))
        axis.set_title("I {:.4f}  D {:.4f}".format(*divergences[action]), fontsize=7, pad=2)
        axis.set_xticks([])
        axis.set_yticks([])
        translation, rotation = divmod(action, NUM_ROTATIONS)
        if rotation == 0:
            axis.set_ylabel(TRANSLATIONS[translation])
        if translation == NUM_TRANSLATIONS - 1:
            axis.set_xlabel(ROTATIONS[rotation])
    figure.tight_layout(rect=(0, 0, 0.92, 1), pad=0.4)
    bar = figure.add_axes((0.93, 0.1, 0.015, 0.8))
    figure.colorbar(ScalarMappable(scale, "plasma"), bar, label="intensity divergence (nats)")
    save(figure, options.out, dpi=80)
    return f"{options.scene} seed {options.scene_seed} after {options.steps_before} steps"


if __name__ == "__main__":
    sys.exit(run_script(Options, save_lookahead))
