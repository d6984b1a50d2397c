"""``ms-slam usme``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from ms_slam_env.benchmark.usme import UsmeOptions, make_suite, run_suite
from ms_slam_env.command_line import parse, report_failures
from ms_slam_env.errors import unknown

_Options = tyro.conf.OmitArgPrefixes[UsmeOptions]


@dataclass(frozen=True)
class Make:
    """Render the eight sequences into folders, in the TUM layout that ms-slam run reads.

    An interrupted call goes on from where it was when the same command is given again.
    """

    out: Path = Path("results/usme_sequences")
    """Folder that gets one folder a sequence."""
    truth: bool = False
    """Also write true depth and object labels."""
    options: _Options = field(default_factory=UsmeOptions)
    """Of the suite."""


@dataclass(frozen=True)
class Run:
    """Run SLAM backends over the eight sequences and print the USME tables.

    Every run has a process of its own. Runs that are in --out already are not repeated.
    """

    folder: tyro.conf.Positional[Path | None] = None
    """Folder that ms-slam usme make wrote; without it every frame is rendered when it is needed."""
    backends: tuple[str, ...] = ("surfel", "odometry")
    """NAME, parameters appended as in surfel,loop_closure=deformation."""
    workers: int = 1
    """Runs at the same time; more than one disturbs the time by the clock."""
    out: Path = Path("results/usme_run")
    """Folder of the results."""
    options: _Options = field(default_factory=UsmeOptions)
    """Of the suite."""


@dataclass(frozen=True)
class Picture:
    """Draw two frames of each of the eight sequences."""

    out: Path = Path("docs/pictures/usme.png")
    """The PNG file to write."""
    seed: int = 2000
    """Of scenes, ways, noise and perturbations."""


COMMANDS: dict[str, type[Make | Run | Picture]] = {"make": Make, "run": Run, "picture": Picture}


def main(arguments: Sequence[str]) -> int:
    """Do one of the three; 1 if a run failed."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name, *rest = arguments
    if name not in COMMANDS:
        raise unknown("command of ms-slam usme", name, COMMANDS)
    command = parse(COMMANDS[name], rest, f"ms-slam usme {name}")
    if isinstance(command, Make):
        folders = make_suite(command.options, command.out, command.truth)
        print(f"{len(folders)} sequences in {command.out}")
        return 0
    if isinstance(command, Picture):
        from ms_slam_env.benchmark.usme_report import save_contact_sheet

        print(f"written: {save_contact_sheet(command.out, command.seed)}")
        return 0
    text, failed = run_suite(
        command.options, command.backends, command.out, command.folder, command.workers
    )
    print(text)
    print(f"written: {command.out}/usme.json, table.md, usme.png", file=sys.stderr)
    return report_failures(failed)


def _usage() -> str:
    lines = [
        f"  {name:<8} {(made.__doc__ or '').splitlines()[0]}" for name, made in COMMANDS.items()
    ]
    head = "usage: ms-slam usme COMMAND [options]; ms-slam usme COMMAND --help lists the options"
    return "\n".join([head, "", *lines])
