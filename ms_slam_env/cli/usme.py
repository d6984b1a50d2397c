"""``ms-slam usme``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ms_slam_env._runtime.command_line import parse
from ms_slam_env.benchmark.usme import Usme, check_suite
from ms_slam_env.cli.experiment import run
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import unknown
from ms_slam_env.sequences.usme_suite import NAMES, make_suite


@dataclass(frozen=True)
class Make(Checked):
    """Render the eight sequences into folders, in the TUM layout that ms-slam run reads.

    Repeat the same command to resume an interrupted call.
    """

    out: Path = Path("results/usme_sequences")
    """Folder that gets one folder per sequence."""
    truth: bool = False
    """Also write true depth and object labels."""
    sequences: tuple[str, ...] = NAMES
    """Names of the sequences to render."""
    image_size: str = "160x120"
    """Size of the images, such as 160x120."""
    seed: int = bounded(2000, 0, 2**32 - 1)
    """Seed of scenes, paths, noise and perturbations."""
    frames_scale: float = bounded(1.0, 0.002, 10.0)
    """Scale of the number of frames on the same paths: 0.5 halves the work and doubles the camera's
    speed."""

    def __post_init__(self) -> None:
        """Refuse unknown sequences and image sizes."""
        super().__post_init__()
        check_suite(self.sequences, self.image_size)


COMMANDS: dict[str, type[Make | Usme]] = {"make": Make, "run": Usme}


def main(arguments: Sequence[str]) -> int:
    """Run the chosen subcommand; return 1 if a run failed."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name, *rest = arguments
    if name not in COMMANDS:
        raise unknown("command of ms-slam usme", name, COMMANDS)
    if name == "run":
        return run(Usme, rest, "ms-slam usme run", Path("results/usme_run"))
    command = parse(Make, rest, f"ms-slam usme {name}")
    folders = make_suite(
        command.out,
        command.sequences,
        command.image_size,
        command.seed,
        command.frames_scale,
        command.truth,
    )
    print(f"{len(folders)} sequences in {command.out}")
    return 0


def _usage() -> str:
    lines = [
        f"  {name:<8} {(made.__doc__ or '').splitlines()[0]}" for name, made in COMMANDS.items()
    ]
    head = "usage: ms-slam usme COMMAND [options]; ms-slam usme COMMAND --help lists the options"
    return "\n".join([head, "", *lines])
