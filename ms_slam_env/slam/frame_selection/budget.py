"""A threshold of divergence that is steered so that a budget is kept: section V-A of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import bounded, check_range
from ms_slam_env.errors import InputError
from ms_slam_env.slam.frame_selection.filters import Change, ChangeConfig, DroppingConfig
from ms_slam_env.slam.frame_selection.selective_slam import FrameFilter
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import OrNone

LOWEST_THRESHOLD = 1e-4  # a frame that changes less is dropped though it could be afforded
HIGHEST_THRESHOLD = 10.0  # a frame that changes more is processed though it cannot be afforded


class ThresholdController(Saved):
    """Raises a threshold with what was spent and lowers it with what was allowed.

    The threshold is ``start exp(gain debt)``, the debt being what was spent beyond what was
    allowed so far: integral control of the logarithm, for changes between frames range over orders
    of magnitude. As the threshold stays between two limits so does the debt, by at most
    ln(highest / lowest) / gain, so that the mean of what is spent tends to what is allowed whatever
    the changes are, provided that they lie between the limits.

    Args:
        start: the threshold without debt.
        gain: per processed frame of debt.
        lowest: the threshold never falls below it; what is left over then is lost.
        highest: the threshold never rises above it.
    """

    saved = ("debt",)

    def __init__(self, start: float, gain: float, lowest: float, highest: float) -> None:
        self._start = start
        self._gain = gain
        self._least = math.log(lowest / start) / gain
        self._most = math.log(highest / start) / gain
        self.debt = 0.0

    def reset(self) -> None:
        """Owe nothing."""
        self.debt = 0.0

    @property
    def threshold(self) -> float:
        """What a change must reach now."""
        return self._start * math.exp(self._gain * self.debt)

    def update(self, spent: float, allowed: float) -> None:
        """Book what a frame cost and what it was allowed to, in processed frames."""
        self.debt = min(max(self.debt + spent - allowed, self._least), self._most)


@dataclass(frozen=True)
class BudgetConfig(DroppingConfig):
    """Frames are dropped below a threshold of divergence that keeps a budget.

    "The threshold can be dynamic and could be a function of the available resources such as battery
    or the processing resources" (Saeedi et al., ICRA 2017, section V-A). Quiet stretches save up
    for violent ones.

    Attributes:
        share: of the frames that may be processed, where there is no ``budget_per_s``.
        budget_per_s: what may be spent in a second of the frames' time stamps, in the unit of the
            costs: joules, processor seconds, frames.
        cost_per_frame: of processing a frame.
        cost_per_look: of judging a frame, processed or not.
        measured: costs are processor seconds as measured instead; no two runs need then be alike.
        gain: how fast the threshold follows: it changes by this share for each processed frame
            too many or too few. Slower lets quiet stretches pay for violent ones, faster keeps the
            budget over shorter times.
        threshold: to begin with, nats.
        change: how it is measured.

    Raises:
        InputError: a value out of range, a share that ``max_skip`` does not permit, or a cost
            where only a share is given.
    """

    name: str = field(default="budget", init=False)
    share: float = bounded(0.5, 1e-4, 1)
    budget_per_s: float | None = bounded(None, 1e-12, 1e12)
    cost_per_frame: float = bounded(1.0, 1e-12, 1e12)
    cost_per_look: float = bounded(0.0, 0, 1e12)
    measured: bool = False
    gain: float = bounded(0.1, 1e-6, 10)
    threshold: float = 0.01
    change: ChangeConfig = field(default_factory=ChangeConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "threshold", LOWEST_THRESHOLD, HIGHEST_THRESHOLD)
        if self.budget_per_s is not None:
            return
        if self.measured or self.cost_per_frame != 1 or self.cost_per_look != 0:
            raise InputError(
                "BudgetConfig: costs are of use with budget_per_s only, not with share"
            )
        if self.share * (self.max_skip + 1) < 1:
            raise InputError(
                f"BudgetConfig.share = {self.share:g} cannot be kept: max_skip = {self.max_skip} "
                f"has 1 of {self.max_skip + 1} frames processed"
            )

    @property
    def uses_clock(self) -> bool:
        """Whether decisions depend on measured time."""
        return self.measured

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter for frames of ``intrinsics``."""
        return BudgetFilter(self, Change(self.change, intrinsics))


class BudgetFilter(Saved, FrameFilter):
    """Admits a frame that differs enough from the last processed one for what can be afforded."""

    saved = ("_change", "_controller", "_time", "_processed", "_allowed", "_spent_s", "_count")

    def __init__(self, config: BudgetConfig, change: Change) -> None:
        self._config = config
        self._change = change
        self._controller = ThresholdController(
            config.threshold, config.gain, LOWEST_THRESHOLD, HIGHEST_THRESHOLD
        )
        self.reset()

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return super().state_like() | {"time": OrNone(0.0)}

    @property
    def threshold(self) -> float:
        """What the change of the next frame must reach, nats."""
        return self._controller.threshold

    def reset(self) -> None:
        """Forget every frame, owe nothing."""
        self._change.reset()
        self._controller.reset()
        self._time: float | None = None
        self._processed = False  # the last frame
        self._allowed = 0.0  # for the last frame
        self._spent_s, self._count = 0.0, 0  # on processed frames, as measured

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether its change reaches the threshold of now."""
        config = self._config
        self._allowed = self._allowance(frame.timestamp)
        admitted = self._change.measure(frame) >= self.threshold
        self._processed = admitted or forced
        if self._processed:
            self._change.keep()
        if not config.measured:
            spent = config.cost_per_look + config.cost_per_frame * self._processed
            self._book(spent, config.cost_per_frame)
        return admitted

    def charge(self, seconds: float) -> None:
        """Book the processor time of the last frame where costs are measured."""
        if not self._config.measured:
            return
        if self._processed:
            self._spent_s += seconds
            self._count += 1
        if self._count:
            self._book(seconds, self._spent_s / self._count)

    def _allowance(self, timestamp: float) -> float:
        """What may be spent since the last frame, in the unit of the costs."""
        config = self._config
        if config.budget_per_s is None:
            return config.share * config.cost_per_frame
        before, self._time = self._time, timestamp
        if before is None:
            return 0.0
        if not timestamp > before:
            raise InputError(
                f"a budget a second needs time stamps that increase; {timestamp:g} s follows "
                f"{before:g} s"
            )
        return config.budget_per_s * (timestamp - before)

    def _book(self, spent: float, unit: float) -> None:
        """Book costs, ``unit`` being that of a processed frame."""
        self._controller.update(spent / unit, self._allowed / unit)
