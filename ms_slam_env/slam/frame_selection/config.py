"""What the configurations of frame selection have in common; all frames, and every n-th.

Every n-th frame is the frame drop rate of the paper's section IV.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass, field

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import Checked, Family, bounded, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.frame_selection.selective_slam import PREDICTIONS, FrameFilter, SelectiveSlam
from ms_slam_env.slam.state import Saved

_ROUNDING = 1e-9  # 13 / 1.3 is less than 10


@dataclass(frozen=True)
class FrameSelectionConfig(Family, ABC):
    """Which frames SLAM processes: Saeedi et al., ICRA 2017, section V-A.

    Made from a mapping: ``from_dict(FrameSelectionConfig, {"name": "divergence", ...})``.

    Attributes:
        name: of the variant.
    """

    name: str = field(default="", init=False)

    @abstractmethod
    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter for frames of ``intrinsics``."""

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """``backend`` with this filter in front of it."""
        return SelectiveSlam(backend, self.make_filter(backend.intrinsics))

    @property
    def uses_clock(self) -> bool:
        """Whether decisions depend on measured time, so that no two runs need be alike."""
        return False


@dataclass(frozen=True)
class EveryFrameConfig(FrameSelectionConfig):
    """Every frame is processed."""

    name: str = field(default="none", init=False)

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter that admits everything."""
        return RegularSkipping(1)

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """The backend as it is."""
        return backend


@dataclass(frozen=True)
class DroppingConfig(Checked, FrameSelectionConfig):
    """Of a filter that drops frames.

    Attributes:
        max_skip: most frames dropped in a row; it protects tracking.
        pose: of a dropped frame: ``constant-velocity``, the last pose moved on as between the
            last two processed frames, at most as far, or ``last``, the last processed frame's. A
            pose that the caller knows or guesses takes precedence.
    """

    _: KW_ONLY
    max_skip: int = bounded(10, 0, 10_000)
    pose: str = chosen("constant-velocity", *PREDICTIONS)

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """``backend`` with this filter in front of it."""
        made = self.make_filter(backend.intrinsics)
        return SelectiveSlam(backend, made, self.max_skip, self.pose)


@dataclass(frozen=True)
class RegularConfig(DroppingConfig):
    """Every n-th frame is processed.

    Attributes:
        every: n; 2.5 takes turns between every second and every third.

    Raises:
        InputError: a value out of range, or more frames to drop in a row than ``max_skip``.
    """

    name: str = field(default="regular", init=False)
    every: float = bounded(2.0, 1, 10_001)

    def __post_init__(self) -> None:
        super().__post_init__()
        longest = math.ceil(self.every) - 1
        if longest > self.max_skip:
            raise InputError(
                f"RegularConfig.every = {self.every:g} drops {longest} frames in a row, more than "
                f"max_skip = {self.max_skip}"
            )

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter."""
        return RegularSkipping(self.every)


class RegularSkipping(Saved, FrameFilter):
    """Admits frames 0, n, 2n, ..., rounded up, counted since ``reset``."""

    saved = ("_count",)

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
