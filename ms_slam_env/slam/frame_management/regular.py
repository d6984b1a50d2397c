"""Frames are processed at regular intervals: the frame drop rate of the paper's section IV."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.slam.frame_management.base import FrameFilter
from ms_slam_env.slam.frame_management.config import DroppingConfig

_ROUNDING = 1e-9  # 13 / 1.3 is less than 10


@dataclass(frozen=True)
class RegularConfig(DroppingConfig):
    """Every n-th frame is processed.

    Attributes:
        every: n; 2.5 takes turns between every second and every third.

    Raises:
        InputError: a value out of range, or more frames to drop in a row than ``max_skip``.
    """

    name: str = field(default="regular", init=False)
    every: float = 2.0

    def __post_init__(self) -> None:
        """Refuse values that contradict each other."""
        super().__post_init__()
        check_range(self, "every", 1, 10_001)
        longest = math.ceil(self.every) - 1
        if longest > self.max_skip:
            raise InputError(
                f"RegularConfig.every = {self.every:g} drops {longest} frames in a row, more than "
                f"max_skip = {self.max_skip}"
            )

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter."""
        return RegularSkipping(self.every)


class RegularSkipping(FrameFilter):
    """Admits frames 0, n, 2n, ..., rounded up, counted since ``reset``."""

    def __init__(self, every: float) -> None:
        self._every = every
        self.reset()

    def reset(self) -> None:
        """Count from 0 again."""
        self._count = 0

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether it is this frame's turn."""
        turns = math.floor(self._count / self._every + _ROUNDING)
        before = math.floor((self._count - 1) / self._every + _ROUNDING)
        self._count += 1
        return turns > before

    def get_state(self) -> dict[str, Any]:
        """The count."""
        return {"count": self._count}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on counting."""
        self._count = state["count"]
