"""Frames too similar to the last processed one are dropped: section V-A of the paper."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.slam.frame_management.base import FrameFilter
from ms_slam_env.slam.frame_management.change import Change, ChangeConfig
from ms_slam_env.slam.frame_management.config import DroppingConfig


@dataclass(frozen=True)
class DivergenceFilterConfig(DroppingConfig):
    """A frame is dropped if its divergence from the last processed frame is below a threshold.

    The paper compares with the previous frame, under which a slow motion would never be seen: each
    frame is like the one before it. Changes add up against the last frame that SLAM has seen.

    Attributes:
        threshold: of the change, nats; 0 drops nothing.
        change: how it is measured.

    Raises:
        InputError: a value out of range.
    """

    name: str = field(default="divergence", init=False)
    threshold: float = 0.01
    change: ChangeConfig = field(default_factory=ChangeConfig)

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        super().__post_init__()
        check_range(self, "threshold", 0, 1e6)

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter for frames of ``intrinsics``."""
        return DivergenceFilter(self.threshold, Change(self.change, intrinsics))


class DivergenceFilter(FrameFilter):
    """Admits a frame that differs enough from the last processed one."""

    def __init__(self, threshold: float, change: Change) -> None:
        self._threshold = threshold
        self._change = change

    def reset(self) -> None:
        """Forget the last processed frame."""
        self._change.reset()

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether its change reaches the threshold."""
        admitted = self._change.measure(frame) >= self._threshold
        if admitted or forced:
            self._change.keep()
        return admitted

    def get_state(self) -> dict[str, Any]:
        """The last processed frame's histograms."""
        return {"change": self._change.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with the last processed frame of a state."""
        self._change.set_state(state["change"])
