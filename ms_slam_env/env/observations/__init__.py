"""Observation variants: one file each."""

from __future__ import annotations

from collections.abc import Callable

from ms_slam_env.camera import Intrinsics
from ms_slam_env.env.observations.base import Observation, RobotKnowledge
from ms_slam_env.env.observations.features import FeaturesObservation
from ms_slam_env.env.observations.lookahead import LookaheadObservation
from ms_slam_env.env.observations.rgbd import RGBDObservation
from ms_slam_env.errors import unknown

OBSERVATIONS: dict[str, Callable[[Intrinsics, int], Observation]] = {
    "rgbd": RGBDObservation,
    "features": FeaturesObservation,
    "lookahead": LookaheadObservation,
}


def make_observation(name: str, intrinsics: Intrinsics, num_actions: int) -> Observation:
    """Build the observation variant ``name``.

    Raises:
        InputError: unknown name.
    """
    if name not in OBSERVATIONS:
        raise unknown("observation", name, OBSERVATIONS)
    return OBSERVATIONS[name](intrinsics, num_actions)


__all__ = ["OBSERVATIONS", "Observation", "RobotKnowledge", "make_observation"]
