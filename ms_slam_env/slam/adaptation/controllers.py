"""What chooses a configuration: the observed divergence (section V-B of the paper), or an agent.

A set of parameters is good up to a maximum information divergence; where more is observed, another
set is taken up, which costs more and copes with it.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from math import inf

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import bounded, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation.adaptive_slam import Controller
from ms_slam_env.slam.adaptation.config import SwitchingConfig, rising
from ms_slam_env.slam.frame_selection import ChangeConfig
from ms_slam_env.slam.frame_selection.divergence import Change
from ms_slam_env.slam.state import Saved


@dataclass(frozen=True)
class DivergenceAdaptationConfig(SwitchingConfig):
    """More divergence between frames, more robust a configuration; with hysteresis.

    Attributes:
        thresholds: K - 1 rising values; where the change between consecutive frames exceeds the
            i-th, configuration i is not good enough. Up at once, as far as needed.
        release_share: of the thresholds, below which the way down is open, (0, 1].
        dwell_frames: down only as far as the largest change of so many frames permits.
        robust_when_lost: the most robust configuration while tracking is lost, and so long after.
        per: the change per ``frame`` or, by the time stamps, per ``second``.
        change: how the change between frames is measured.

    Raises:
        InputError: another number of thresholds than of configurations less one, thresholds that
            do not rise, or a value out of range.
    """

    name: str = field(default="divergence", init=False)
    thresholds: tuple[float, ...] = (0.004, 0.01)
    release_share: float = bounded(0.7, 0.001, 1)
    dwell_frames: int = bounded(6, 1, 1_000_000)
    robust_when_lost: bool = True
    per: str = chosen("frame", "frame", "second")
    change: ChangeConfig = field(default_factory=ChangeConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        wanted = self.num_configurations - 1
        object.__setattr__(self, "thresholds", rising(self.thresholds, "thresholds", wanted))

    def make_controller(self, intrinsics: Intrinsics) -> Controller:
        """The controller for frames of ``intrinsics``."""
        return DivergenceController(self, intrinsics)


class DivergenceController(Saved, Controller):
    """Up at once, down after a while below.

    Attributes:
        change: between the last two frames, nats or nats per second; 0 before the second frame.
    """

    saved = ("_measure", "change", "_time_s", "index", "_recent")

    def __init__(self, config: DivergenceAdaptationConfig, intrinsics: Intrinsics) -> None:
        self._config = config
        self._measure = Change(config.change, intrinsics)
        self._release = [config.release_share * x for x in config.thresholds]
        self.reset()

    def reset(self) -> None:
        """Forget every frame."""
        self._measure.reset()
        self.change = 0.0
        self._time_s: float | None = None  # of the last frame
        self.index = self._config.first
        self._recent: list[float] = []  # changes of the last frames, as many as the dwell

    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """Index by the change from the frame before."""
        is_first = self._time_s is None
        self._observe(frame)
        if is_first:
            return self.index
        config = self._config
        change = inf if is_lost and config.robust_when_lost else self.change
        self._recent = [*self._recent, change][-config.dwell_frames :]
        self.index = max(self.index, bisect_right(config.thresholds, change))
        if len(self._recent) == config.dwell_frames:
            self.index = min(self.index, bisect_right(self._release, max(self._recent)))
        return self.index

    def _observe(self, frame: RGBDFrame) -> None:
        """Measure the change from the frame before; it is the reference from now on."""
        nats = self._measure.measure(frame)
        self._measure.keep()
        before, self._time_s = self._time_s, frame.timestamp
        if before is None:
            return
        if self._config.per == "second":
            if not frame.timestamp > before:
                raise InputError(
                    f"a change per second needs time stamps that increase, got {before} s, then "
                    f"{frame.timestamp} s"
                )
            nats /= frame.timestamp - before
        self.change = nats


@dataclass(frozen=True)
class AgentConfig(SwitchingConfig):
    """``AdaptiveSlam.use(index)`` says which configuration is in force."""

    name: str = field(default="agent", init=False)

    def make_controller(self, intrinsics: Intrinsics) -> Controller:
        """The controller that is told."""
        return AgentController(self.num_configurations, self.first)


class AgentController(Saved, Controller):
    """Keeps to what it was told last."""

    saved = ("index",)

    def __init__(self, count: int, first: int) -> None:
        self._count, self._first = count, first
        self.reset()

    def reset(self) -> None:
        """Back to the first."""
        self.index = self._first

    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """The index told."""
        return self.index

    def use(self, index: int) -> None:
        """Take configuration ``index`` from the next frame on."""
        if not 0 <= index < self._count:
            raise InputError(f"configuration {index!r} is outside [0, {self._count - 1}]")
        self.index = int(index)
