"""Observation variants by name; each is imported when it is built.

They read the map through kernels, which are slow to load.
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
    """Whether the observation needs an occupancy grid carved from the frames."""
    candidate_numbers: int = 0
    """Values per motion at the end of the vector, motion by motion; for networks that use them."""
    image_shape: tuple[int, ...] = ()
    """Channels, rows and columns of an image at the end of the vector; for networks that use it."""

    @abstractmethod
    def build(self, knowledge: RobotKnowledge) -> Any:
        """Return the observation, an element of ``space``."""


_OWN = "ms_slam_env.env.observations"

OBSERVATIONS = {
    "rgbd": f"{_OWN}:RGBDObservation",
    "images": f"{_OWN}:ImagesObservation",
    "pixels": f"{_OWN}:PixelsObservation",
    "features": f"{_OWN}:FeaturesObservation",
    "lookahead": f"{_OWN}:LookaheadObservation",
    "map": f"{_OWN}:MapObservation",
    "goals": f"{_OWN}:GoalsObservation",
    "held": f"{_OWN}:HeldObservation",
    "candidates": f"{_OWN}:CandidatesObservation",
}
"""Class path of each name of the option ``observation``."""

POINT = ExtensionPoint(
    "observation",
    "ms_slam_env.observations",
    Observation,
    own=OBSERVATIONS,
    takes=("intrinsics", "num_motions"),
)
"""Lookup of observations; each is built from the intrinsics and the number of motions."""
