"""``ms-slam train``."""

from __future__ import annotations

from collections.abc import Sequence

from ms_slam_env._runtime.extension import ExtensionPoint

TRAINERS = ExtensionPoint("trainer", "ms_slam_env.trainers", form="module:function")
DEFAULT_TRAINER = "sb3"


def main(arguments: Sequence[str]) -> int:
    """Hand the arguments to a trainer: ``ms-slam train [TRAINER] [its options]``."""
    rest = list(arguments)
    name = rest.pop(0) if rest and not rest[0].startswith("-") else DEFAULT_TRAINER
    return int(TRAINERS.find(name)(rest) or 0)
