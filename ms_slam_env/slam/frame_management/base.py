"""The interface of every filter that decides which frames SLAM processes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from ms_slam_env.camera import RGBDFrame


class FrameFilter(ABC):
    """Decides, frame by frame, whether SLAM processes it.

    The first frame, those while tracking is lost and those after the longest permitted gap are
    processed whatever the filter says; it is asked about them all the same.
    """

    @abstractmethod
    def reset(self) -> None:
        """Forget every frame."""

    @abstractmethod
    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether ``frame`` is to be processed.

        Args:
            frame: the sensor's frame.
            dropped: frames that were dropped since the last processed one.
            forced: the frame is processed whatever the answer is; the filter takes note.
        """

    def charge(self, seconds: float) -> None:  # noqa: B027 -- most take no notice
        """Take note of the processor time that the last frame took, its judgement included."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays and plain values."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
