"""The command line ``ms-slam``; each command is imported only when it runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from ms_slam_env._runtime.command_line import exit_code
from ms_slam_env.errors import unknown

COMMANDS = {
    "benchmark": "run planners on scenes with SLAM in the loop and compare them",
    "compare": "run SLAM backends over the same sequences and compare them",
    "divergence": "measure how hard recorded sequences are, from frame to frame",
    "docs": "write the tables of Markdown pages from committed results",
    "evaluate": "compare an estimated trajectory (TUM file) or map (PLY) with the truth",
    "experiment": "run one of the project's experiments, or list them",
    "explore": "search the parameters of a SLAM backend for the best compromises",
    "generate": "render an RGB-D sequence with true poses into a folder",
    "record": "record episodes of a planner as a dataset for offline learning",
    "report": "turn a folder of results into one HTML page",
    "run": "run a SLAM backend over a recorded RGB-D sequence",
    "train": "train an agent with one of the installed training scripts",
    "usme": "make the eight USME sequences, and run SLAM backends over them",
    "view": "look inside an episode with the Rerun viewer",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 success, 1 failure, 2 bad input."""
    return exit_code(lambda: _run(list(sys.argv[1:] if argv is None else argv)))


def _run(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from ms_slam_env import __version__

        print(__version__)
        return 0
    command, *rest = arguments
    if command not in COMMANDS:
        raise unknown("command", command, COMMANDS)
    return int(import_module(f"ms_slam_env.cli.{command}").main(rest))


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: ms-slam COMMAND [options]; ms-slam COMMAND --help lists the options",
            "",
            *lines,
        ]
    )
