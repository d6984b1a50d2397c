"""Controls the divergence threshold to keep a budget: section V-A of the paper."""

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

LOWEST_THRESHOLD = 1e-4  # a frame that changes less is dropped even if affordable
HIGHEST_THRESHOLD = 10.0  # a frame that changes more is processed even if not affordable


class ThresholdController(Saved):
    """Raises a threshold with spending and lowers it with the allowance.

    The threshold is ``start exp(gain debt)``, where the debt is total spending minus total
    allowance. It is integral control of the logarithm, because changes between frames range over
    orders of magnitude. The threshold stays between two limits, so the debt varies by at most
    ln(highest / lowest) / gain. Mean spending therefore tends to the allowance, provided that the
    changes lie between the limits.

    Args:
        start: the threshold without debt.
        gain: change of the threshold's logarithm per processed frame of debt.
        lowest: lower limit of the threshold; allowance unused there is lost.
        highest: upper limit of the threshold.
    """

    saved = ("debt",)

    def __init__(self, start: float, gain: float, lowest: float, highest: float) -> None:
        self._start = start
        self._gain = gain
        self._least = math.log(lowest / start) / gain
        self._most = math.log(highest / start) / gain
        self.debt = 0.0

    def reset(self) -> None:
        """Clear the debt."""
        self.debt = 0.0

    @property
    def threshold(self) -> float:
        """The threshold that a change must reach now."""
        return self._start * math.exp(self._gain * self.debt)

    def update(self, spent: float, allowed: float) -> None:
        """Account for a frame's cost and allowance, in units of processed frames."""
        self.debt = min(max(self.debt + spent - allowed, self._least), self._most)


@dataclass(frozen=True)
class BudgetConfig(DroppingConfig):
    """Drops frames below a divergence threshold that is controlled to keep a budget.

    "The threshold can be dynamic and could be a function of the available resources such as battery
    or the processing resources" (Saeedi et al., ICRA 2017, section V-A). Periods of little change
    save for periods of much change.

    Attributes:
        share: share of the frames that may be processed; used without ``budget_per_s``.
        budget_per_s: budget per second of the frames' time stamps, in the unit of the costs:
            joules, processor seconds or frames.
        cost_per_frame: cost of processing a frame.
        cost_per_look: cost of judging a frame, whether processed or not.
        measured: use measured processor seconds as costs; runs are then not reproducible.
        gain: how fast the threshold adapts: its relative change per processed frame too many or too
            few. A lower gain averages over more change; a higher one keeps the budget over shorter
            times.
        threshold: initial threshold, nats.
        change: how the change is measured.

    Raises:
        InputError: a value out of range, a share that ``max_skip`` does not permit, or a cost
            although only a share is given.
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
        """Make the filter for frames of ``intrinsics``."""
        return BudgetFilter(self, Change(self.change, intrinsics))


class BudgetFilter(Saved, FrameFilter):
    """Admits a frame that differs enough from the last processed one, given the budget."""

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
        """Threshold for the next frame's change, nats."""
        return self._controller.threshold

    def reset(self) -> None:
        """Forget every frame, and clear the debt."""
        self._change.reset()
        self._controller.reset()
        self._time: float | None = None
        self._processed = False  # whether the last frame was
        self._allowed = 0.0  # for the last frame
        self._spent_s, self._count = 0.0, 0  # measured on processed frames

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether its change reaches the current threshold."""
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
        """Account for the last frame's processor time if costs are measured."""
        if not self._config.measured:
            return
        if self._processed:
            self._spent_s += seconds
            self._count += 1
        if self._count:
            self._book(seconds, self._spent_s / self._count)

    def _allowance(self, timestamp: float) -> float:
        """Allowance since the last frame, in the unit of the costs."""
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
        """Account for costs; ``unit`` is the cost of a processed frame."""
        self._controller.update(spent / unit, self._allowed / unit)
