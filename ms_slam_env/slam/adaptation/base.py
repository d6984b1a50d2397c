"""The interface of everything that chooses among the configurations of a running SLAM."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.errors import InputError


class Controller(ABC):
    """Chooses before every frame one of the configurations, by index from fast to robust.

    Attributes:
        index: of the configuration chosen last; of the first one before any frame.
    """

    index: int

    @abstractmethod
    def reset(self) -> None:
        """Forget every frame."""

    @abstractmethod
    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """Index of the configuration under which ``frame`` is to be processed.

        Args:
            frame: the sensor's frame.
            is_lost: whether SLAM has not started or has lost track.
        """

    def use(self, index: int) -> None:
        """Take configuration ``index`` from the next frame on.

        Raises:
            InputError: this variant chooses by itself.
        """
        raise InputError("configurations are chosen from outside under adaptation 'agent' only")

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays and plain values."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
