"""Filters that select frames: all, every n-th, or those unlike the last processed one.

Every n-th frame is the frame drop rate of the paper's section IV; the last is its section V-A.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.camera import Intrinsics, RGBDFrame, check_frame, intensity_image
from ms_slam_env.config import Checked, Family, bounded, chosen
from ms_slam_env.divergence import DivergenceConfig, Histograms, make_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import read_levels
from ms_slam_env.slam.frame_selection.selective_slam import PREDICTIONS, FrameFilter, SelectiveSlam
from ms_slam_env.slam.shared.state import Saved, Stateful
from ms_slam_env.slam.shared.state_check import ArrayOf, Fields, OrNone
from ms_slam_env.slam.slam_backend import SlamBackend

_ROUNDING = 1e-9  # 13 / 1.3 is less than 10


@dataclass(frozen=True)
class FrameSelectionConfig(Family, ABC):
    """Which frames SLAM processes; made by ``from_dict(FrameSelectionConfig, {"name": ...})``."""

    name: str = field(default="", init=False)

    @abstractmethod
    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """Make the filter for frames of ``intrinsics``."""

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """Put this filter in front of ``backend``."""
        return SelectiveSlam(backend, self.make_filter(backend.intrinsics))

    @property
    def uses_clock(self) -> bool:
        """Whether decisions depend on measured time, so that runs are not reproducible."""
        return False


@dataclass(frozen=True)
class EveryFrameConfig(FrameSelectionConfig):
    """Processes every frame."""

    name: str = field(default="none", init=False)

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """Make the filter that admits everything."""
        return RegularSkipping(1)

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """Return the backend unchanged."""
        return backend


@dataclass(frozen=True)
class DroppingConfig(Checked, FrameSelectionConfig):
    """Base of filters that drop frames.

    Attributes:
        max_skip: most frames dropped in a row, to protect tracking.
        pose: pose of a dropped frame: ``constant-velocity``, the last pose extrapolated by at most
            the motion between the last two processed frames, or ``last``, the last processed
            frame's pose. A pose that the caller knows or guesses takes precedence.
    """

    _: KW_ONLY
    max_skip: int = bounded(10, 0, 10_000)
    pose: str = chosen("constant-velocity", *PREDICTIONS)

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """Put this filter in front of ``backend``."""
        made = self.make_filter(backend.intrinsics)
        return SelectiveSlam(backend, made, self.max_skip, self.pose)


@dataclass(frozen=True)
class RegularConfig(DroppingConfig):
    """Processes every n-th frame.

    Attributes:
        every: n; 2.5 alternates between every second and every third.

    Raises:
        InputError: a value out of range, or more consecutive drops than ``max_skip``.
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
        """Make the filter."""
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


@dataclass(frozen=True)
class ChangeConfig(Checked):
    """How the change between two frames is measured.

    The change is delta_I + depth_weight delta_D in nats, from equations (5) and (10): the sum in
    the paper's Algorithm 1, with lambda as weight.

    Attributes:
        width: approximate number of columns that pixels are subsampled to, to keep judging a frame
            cheap.
        depth_weight: lambda. On hand-held sequences of validation seeds the sum with 1 followed the
            size of the motion at least as well as either divergence alone.
        divergence: parameters of the two divergences.
    """

    width: int = bounded(80, 8, 10_000)
    depth_weight: float = bounded(1.0, 0, 1e6)
    divergence: DivergenceConfig = field(default_factory=DivergenceConfig)


class Change(Stateful):
    """Measures the change of each frame from a reference frame."""

    def __init__(self, config: ChangeConfig, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._stride = max(1, intrinsics.width // config.width)
        reduced = intrinsics.every_nth(self._stride)
        self._size = reduced.shape
        self._measure = make_divergence(config.divergence, reduced)
        self._weights = np.array([1.0, config.depth_weight])
        self._reference: Histograms | None = None
        self._current: Histograms | None = None

    def reset(self) -> None:
        """Forget the reference."""
        self._reference = self._current = None

    def measure(self, frame: RGBDFrame) -> float:
        """Change of ``frame`` from the reference, nats; infinite without one."""
        check_frame(frame, self._intrinsics)
        s = self._stride
        grey = intensity_image(np.ascontiguousarray(frame.color[::s, ::s])).astype(np.float32)
        depth = frame.depth[::s, ::s].astype(np.float32)
        self._current = self._measure.histograms(grey[None], depth[None])
        if self._reference is None:
            return np.inf
        return float(self._measure.divergence(self._current, self._reference)[0] @ self._weights)

    def keep(self) -> None:
        """Make the last measured frame the reference."""
        self._reference = self._current

    def get_state(self) -> dict[str, Any]:
        """The reference's histograms."""
        kept = self._reference
        if kept is None:
            return {"intensity": None, "normals": None}
        return {"intensity": kept.intensity.copy(), "normals": kept.normals.copy()}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        blank = self._measure.histograms(*(np.zeros((1, *self._size), np.float32),) * 2)
        like = {
            name: OrNone(ArrayOf(rows.dtype, rows.shape, least=0, is_distribution=True))
            for name, rows in (("intensity", blank.intensity), ("normals", blank.normals))
        }
        return Fields(like, _why_no_reference)

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the reference from a state."""
        self._current = None
        if state["intensity"] is None:
            self._reference = None
        else:
            self._reference = Histograms(state["intensity"].copy(), state["normals"].copy())


def _why_no_reference(state: dict[str, Any]) -> str:
    """What is inconsistent between a state's two histograms."""
    is_whole = (state["intensity"] is None) == (state["normals"] is None)
    return "" if is_whole else "has one of the two histograms"


@dataclass(frozen=True)
class DivergenceFilterConfig(DroppingConfig):
    """Drops a frame if its divergence from a reference frame is below a threshold.

    Attributes:
        threshold: least change of a processed frame, nats; 0 drops nothing.
        reference: ``processed``, the last processed frame, from which changes add up; or
            ``previous``, the frame before, dropped or not, as the paper words it. With ``previous``
            slow motion goes unnoticed: each frame is like the one before, and only ``max_skip``
            lets one through.
        change: how the change is measured.
        levels: file written by a design-space exploration, whose threshold is used; reset to None
            once read.
    """

    name: str = field(default="divergence", init=False)
    threshold: float = bounded(0.01, 0, 1e6)
    reference: str = chosen("processed", "processed", "previous")
    change: ChangeConfig = field(default_factory=ChangeConfig)
    levels: str | Path | None = None

    def __post_init__(self) -> None:
        if self.levels is not None:
            found = read_levels(self.levels, "frame_management")
            object.__setattr__(self, "threshold", found.get("threshold"))
            object.__setattr__(self, "levels", None)
        super().__post_init__()

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """Make the filter for frames of ``intrinsics``."""
        change = Change(self.change, intrinsics)
        return DivergenceFilter(self.threshold, change, self.reference == "previous")


class DivergenceFilter(Saved, FrameFilter):
    """Admits a frame that differs enough from the last processed one, or from the one before."""

    saved = ("_change",)

    def __init__(self, threshold: float, change: Change, from_previous: bool = False) -> None:
        self._threshold = threshold
        self._change = change
        self._from_previous = from_previous

    def reset(self) -> None:
        """Forget the last processed frame."""
        self._change.reset()

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether its change reaches the threshold."""
        admitted = self._change.measure(frame) >= self._threshold
        if admitted or forced or self._from_previous:
            self._change.keep()
        return admitted
