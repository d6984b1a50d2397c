"""Every n-th frame is processed: the frame drop rate of the paper's section IV."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.slam.frame_management.base import FrameFilter
from ms_slam_env.slam.frame_management.config import DroppingConfig


@dataclass(frozen=True)
class RegularConfig(DroppingConfig):
    """Every n-th frame is processed.

    Attributes:
        every: n.

    Raises:
        InputError: a value out of range, or more frames to drop in a row than ``max_skip``.
    """

    name: str = field(default="regular", init=False)
    every: int = 2

    def __post_init__(self) -> None:
        """Refuse values that contradict each other."""
        super().__post_init__()
        check_range(self, "every", 1, 10_001)
        if self.every - 1 > self.max_skip:
            raise InputError(
                f"RegularConfig.every = {self.every} drops {self.every - 1} frames in a row, more "
                f"than max_skip = {self.max_skip}"
            )

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter."""
        return RegularSkipping(self.every)


class RegularSkipping(FrameFilter):
    """Admits a frame when ``every - 1`` have been dropped."""

    def __init__(self, every: int) -> None:
        self._every = every

    def reset(self) -> None:
        """Nothing to forget."""

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether it is this one's turn."""
        return dropped >= self._every - 1

    def get_state(self) -> dict[str, Any]:
        """Nothing: the count of dropped frames is the caller's."""
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""
