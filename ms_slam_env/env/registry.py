"""Observation variants by name; each is imported where it is made.

They look at the map through kernels, which take a while to load.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from gymnasium import spaces

from ms_slam_env._runtime.extension import ExtensionPoint

if TYPE_CHECKING:
    from ms_slam_env.env.robot_knowledge import RobotKnowledge


class Observation(ABC):
    """One observation variant."""

    space: spaces.Space[Any]
    needs_occupancy: bool = False
    """Whether an occupancy grid is to be carved from the frames."""
    candidate_numbers: int = 0
    """Numbers of each motion at the end, motion by motion, for networks that look at them so."""
    image_shape: tuple[int, ...] = ()
    """Channels, rows and columns of an image at the end, for networks that look at it so."""

    @abstractmethod
    def build(self, knowledge: RobotKnowledge) -> Any:
        """Return the observation, an element of ``space``."""


_OWN = "ms_slam_env.env.observations"

OBSERVATIONS = {
    "rgbd": f"{_OWN}:RGBDObservation",
    "pixels": f"{_OWN}:PixelsObservation",
    "features": f"{_OWN}:FeaturesObservation",
    "lookahead": f"{_OWN}:LookaheadObservation",
    "map": f"{_OWN}:MapObservation",
    "goals": f"{_OWN}:GoalsObservation",
    "held": f"{_OWN}:HeldObservation",
    "candidates": f"{_OWN}:CandidatesObservation",
}
"""Name of the option ``observation`` to where the variant is."""

POINT = ExtensionPoint("observation", "ms_slam_env.observations", Observation, own=OBSERVATIONS)
"""Where observations are found; each is made of intrinsics and the number of motions."""
