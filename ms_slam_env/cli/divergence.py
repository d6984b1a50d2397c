"""``ms-slam divergence``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from ms_slam_env._runtime.command_line import parse


@dataclass(frozen=True)
class Arguments:
    """Measure how hard sequences are: frame-to-frame divergence, as in the paper's Table I.

    Accepts the layouts of ms-slam run. Writes divergence.json, table.md and divergence.png.
    """

    sequences: tyro.conf.Positional[tuple[str, ...]]
    """Folders of recordings, or scene:seed[:word[+word ...]]."""
    image_size: str = "native"
    """Reduce the images to this size, such as 160x120; 160x120+crop first crops them centrally to
    that aspect ratio."""
    layout: str = "auto"
    """auto, tum, icl-nuim, 7-scenes, folder, euroc, kitti or bag."""
    every: int = 1
    """Take every n-th frame."""
    paper: bool = False
    """Use the paper's histograms (256 levels, no smoothing) instead of this package's defaults."""
    measure: str = "kl"
    """kl (the paper's), windowed-kl, earth-movers (exact), or wasserstein: how far observations of
    the same surface move (Saeedi et al., ICRA 2019; needs true poses)."""
    out: Path = Path("results/divergence")
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Measure, write and print the table."""
    args = parse(Arguments, arguments, "ms-slam divergence")
    from ms_slam_env._runtime.result_folders import alone_in
    from ms_slam_env.divergence import DivergenceConfig
    from ms_slam_env.errors import InputError
    from ms_slam_env.evaluation.sequence_divergence import sequence_divergence, write_divergences
    from ms_slam_env.sequences import open_sequence

    if not args.sequences:
        raise InputError("no sequence given")
    config = DivergenceConfig.paper() if args.paper else DivergenceConfig()
    opened = [open_sequence(name, args.image_size, layout=args.layout) for name in args.sequences]
    settings = {
        "divergence": {**asdict(config), "measure": args.measure},
        "image_size": args.image_size,
        "every": args.every,
    }
    with alone_in(args.out):
        measured = [sequence_divergence(one, config, args.every, args.measure) for one in opened]
        print(write_divergences(measured, settings, args.out).as_markdown())
    print(f"written: {args.out}/divergence.json, table.md, divergence.png", file=sys.stderr)
    return 0
