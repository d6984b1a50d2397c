"""``ms-slam train``."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points

from ms_slam_env.errors import InputError, unknown

GROUP = "ms_slam_env.trainers"
DEFAULT_TRAINER = "sb3"


def main(arguments: Sequence[str]) -> int:
    """Hand the arguments to a trainer: ``ms-slam train [TRAINER] [its options]``."""
    rest = list(arguments)
    name = rest.pop(0) if rest and not rest[0].startswith("-") else DEFAULT_TRAINER
    trainers = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in trainers:
        raise unknown("trainer", name, sorted(trainers))
    try:
        train = trainers[name].load()
    except ModuleNotFoundError as error:
        raise InputError(
            f"trainer {name!r} needs {error.name}: pip install 'ms-slam-env[train]'"
        ) from error
    return int(train(rest) or 0)
