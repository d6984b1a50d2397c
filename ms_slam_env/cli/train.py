"""``ms-slam train``."""

from __future__ import annotations

import inspect
from collections.abc import Sequence

from ms_slam_env._runtime.extension import ExtensionPoint
from ms_slam_env.errors import InputError

TRAINERS = ExtensionPoint("trainer", "ms_slam_env.trainers", form="module:function")
DEFAULT_TRAINER = "sb3"


def main(arguments: Sequence[str]) -> int:
    """Hand the arguments to a trainer: ``ms-slam train [TRAINER] [its options]``."""
    rest = list(arguments)
    if rest[:1] in (["-h"], ["--help"]):
        print(listing(), end="\n\n", flush=True)
    name = rest.pop(0) if rest and not rest[0].startswith("-") else DEFAULT_TRAINER
    return int(TRAINERS.find(name)(rest) or 0)


def listing() -> str:
    """List every trainer with the first line of its docstring."""
    names, default = TRAINERS.names(), DEFAULT_TRAINER
    width = max(map(len, names), default=0)
    lines = [f"  {name:<{width}}  {_title(name)}" for name in names]
    return "\n".join(
        [
            f"usage: ms-slam train [{'|'.join(names)}|{TRAINERS.form}] [options]",
            "",
            *lines,
            "",
            f"ms-slam train NAME --help lists the options; these are of {default}, the default:",
        ]
    )


def _title(name: str) -> str:
    try:
        found = TRAINERS.find(name)
    except InputError as error:  # of an extra, or of another package
        return f"({error})"
    return (inspect.getdoc(found) or "").partition("\n")[0]
