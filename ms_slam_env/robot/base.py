"""What carries the camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


class Embodiment(ABC):
    """Holds the camera in the world and executes one of ``n`` candidate motions."""

    T_world_camera: Float64
    num_actions: int

    @abstractmethod
    def reset(self, T_world_camera: Float64, rng: np.random.Generator) -> None:
        """Put the camera at a start pose (4, 4)."""

    @abstractmethod
    def candidate_motions(self) -> Float64:
        """The motions ``T_camera_next`` (n, 4, 4) that the actions would make from here."""

    @abstractmethod
    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) whether each motion can be made without touching anything."""

    @abstractmethod
    def move(self, action: int) -> bool:
        """Make motion ``action`` if nothing blocks it; return whether it was made."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
