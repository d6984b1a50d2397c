"""The command line ``ms-slam``; each command is imported only when it is called."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from ms_slam_env.errors import InputError

COMMANDS = {
    "benchmark": "run planners on scenes with SLAM in the loop and compare them",
    "evaluate": "compare an estimated trajectory with the truth (TUM files)",
    "train": "train an agent with one of the installed training scripts",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0 success, 1 failure, 2 bad input."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from ms_slam_env import __version__

        print(__version__)
        return 0
    command, *rest = arguments
    if command not in COMMANDS:
        return _refuse(f"unknown command {command!r}; valid choices: {', '.join(COMMANDS)}")
    try:
        return int(import_module(f"ms_slam_env.cli.{command}").main(rest))
    except InputError as error:
        return _refuse(str(error))
    except RuntimeError as error:
        print(f"ms-slam: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("ms-slam: interrupted; finished work is kept", file=sys.stderr)
        return 130


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


def _refuse(message: str) -> int:
    print(f"ms-slam: error: {message}", file=sys.stderr)
    return 2
