"""Things that move through a scene: a parcel, a walking person, a car."""

from __future__ import annotations

from collections.abc import Callable

from ms_slam_env.errors import unknown
from ms_slam_env.scenes.movers.car import car
from ms_slam_env.scenes.movers.person import person
from ms_slam_env.scenes.movers.shape import Joint, Part, Shape, box
from ms_slam_env.scenes.scene import Rng

MOVERS: dict[str, Callable[[Rng], Shape]] = {"box": box, "person": person, "car": car}
"""Kind to what builds one from random numbers."""


def make_mover(kind: str, rng: Rng) -> Shape:
    """Build a thing that moves; the same random numbers give the same thing.

    Raises:
        InputError: unknown kind.
    """
    if kind not in MOVERS:
        raise unknown("moving object", kind, MOVERS)
    return MOVERS[kind](rng)


__all__ = ["MOVERS", "Joint", "Part", "Shape", "box", "car", "make_mover", "person"]
