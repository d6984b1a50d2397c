"""``python -m ms_slam_env.benchmark.lookahead_figure``: the paper's Fig. 7.

The 49 predicted images of one moment with their divergences from the reference.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle

from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.robot import NUM_ROTATIONS, NUM_TRANSLATIONS, ROTATIONS, TRANSLATIONS

PROGRAM = "python -m ms_slam_env.benchmark.lookahead_figure"


@dataclass(frozen=True)
class Args:
    """Draw the 49 predicted images of one moment with their divergences."""

    out: Path = Path("docs/pictures/lookahead.png")
    scene: str = "living_room"
    scene_seed: int = 2000
    seed: int = 2000
    steps_before: int = 20


def main() -> int:
    """Move at random for a while, predict the 49 candidates and draw them; return the exit code."""
    args = parse(Args, None, PROGRAM)
    env = gymnasium.make("MSActiveSLAM-FreeCamera-v0", scene=args.scene, scene_seed=args.scene_seed)
    _, info = env.reset(seed=args.seed)
    rng = np.random.default_rng(args.seed)
    for _ in range(args.steps_before):
        _, _, _, _, info = env.step(rng.choice(np.flatnonzero(info["action_mask"])))
    active = env.unwrapped
    views, divergences = active.predict_candidates(), active.lookahead()  # type: ignore[attr-defined]
    figure, axes = plt.subplots(NUM_TRANSLATIONS, NUM_ROTATIONS, figsize=(14, 11.5))
    scale = Normalize(0, divergences[:, 0].max())
    for action, axis in enumerate(axes.ravel()):
        axis.imshow(views.intensity[action], cmap="gray", vmin=0, vmax=255)
        corner = (0, 0), views.intrinsics.width * 0.16, views.intrinsics.height * 0.2
        axis.add_patch(Rectangle(*corner, color=plt.cm.plasma(scale(divergences[action, 0]))))
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
    figure.colorbar(
        plt.cm.ScalarMappable(scale, "plasma"), bar, label="intensity divergence (nats)"
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out, dpi=80)
    print(f"{args.out}: {args.scene} seed {args.scene_seed} after {args.steps_before} steps")
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
