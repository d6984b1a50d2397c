"""Objects that move through a scene: a box, a walking person, a car."""

from __future__ import annotations

from collections.abc import Callable

from ms_slam_env.errors import unknown
from ms_slam_env.scenes.movers.car import car
from ms_slam_env.scenes.movers.person import person
from ms_slam_env.scenes.movers.shape import Joint, Part, Shape, box
from ms_slam_env.scenes.scene import Rng

MOVERS: dict[str, Callable[[Rng], Shape]] = {"box": box, "person": person, "car": car}
"""Builder of each kind, which takes a random generator."""


def make_mover(kind: str, rng: Rng) -> Shape:
    """Build a moving object; the same random numbers give the same object.

    Raises:
        InputError: unknown kind.
    """
    if kind not in MOVERS:
        raise unknown("moving object", kind, MOVERS)
    return MOVERS[kind](rng)


__all__ = ["MOVERS", "Joint", "Part", "Shape", "box", "car", "make_mover", "person"]
