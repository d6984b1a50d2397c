"""Controllers that choose a configuration, by observed divergence or as an agent says.

Section V-B of the paper: a set of parameters works up to a maximum information divergence. Above
it, a more expensive set takes over that copes with more.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import Checked, Family, bounded, check_range, chosen
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation.adaptive_slam import (
    AdaptiveSlam,
    Controller,
    as_configurations,
    default_configurations,
    make_levels,
)
from ms_slam_env.slam.configuration import SlamConfiguration, read_levels
from ms_slam_env.slam.frame_selection import ChangeConfig
from ms_slam_env.slam.frame_selection.filters import Change
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ListOf, OrNone, Real, WholeNumber
from ms_slam_env.slam.slam_backend import SlamBackend


def rising(values: Any, name: str, count: int) -> tuple[float, ...]:
    """Return ``values`` as a tuple of ``count`` positive, strictly increasing numbers.

    Raises:
        InputError: they are anything else.
    """
    is_list = isinstance(values, (tuple, list))
    numbers = [x for x in values if isinstance(x, (int, float))] if is_list else []
    is_rising = all(a < b for a, b in itertools.pairwise([0, *numbers]))
    if not is_rising or not is_list or not len(numbers) == len(values) == count:
        raise InputError(f"{name} = {values!r} must be {count} increasing positive numbers")
    return tuple(float(x) for x in numbers)


@dataclass(frozen=True)
class AdaptationConfig(Checked, Family, ABC):
    """How a running SLAM changes its configuration: Saeedi et al., ICRA 2017, section V-B.

    Make one from a mapping: ``from_dict(AdaptationConfig, {"name": "divergence", ...})``.
    """

    @abstractmethod
    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """Add this adaptation to ``backend``; ``keep_every`` applies only if ``drops_frames``.

        Raises:
            InputError: the backend cannot change its configuration, or not to one of these, while
                SLAM runs.
        """


@dataclass(frozen=True)
class NoAdaptationConfig(AdaptationConfig):
    """No adaptation: the configuration never changes."""

    name: str = field(default="none", init=False)

    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """Return the backend unchanged."""
        return backend


@dataclass(frozen=True)
class SwitchingConfig(AdaptationConfig):
    """Base of adaptations that switch between configurations.

    Attributes:
        configurations: at least two, from fast to robust: YAML files of ``SlamConfiguration``,
            mappings of its fields, or such objects. Omitted options keep the backend's values.
            None: three that suit the camera (``default_configurations``).
        start: index of the configuration to start with; None: the last, the most robust.
        costs: positive, increasing cost of each configuration: a deterministic substitute for
            processor time. None: ``about.cost`` of each configuration.

    Raises:
        InputError: a bad configuration, an index out of range, or bad costs.
    """

    configurations: Any = None
    start: int | None = None
    costs: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.configurations is not None:
            object.__setattr__(self, "configurations", as_configurations(self.configurations))
            if len(self.configurations) < 2:
                raise InputError("configurations must be at least two, from fast to robust")
        if self.start is not None:
            check_range(self, "start", 0, self.num_configurations - 1)
        if self.costs is not None:
            count = self.num_configurations
            object.__setattr__(self, "costs", rising(self.costs, "costs", count))

    @property
    def num_configurations(self) -> int:
        """Number K of configurations."""
        return 3 if self.configurations is None else len(self.configurations)

    @property
    def first(self) -> int:
        """Index of the configuration to start with."""
        return self.num_configurations - 1 if self.start is None else self.start

    def resolved(self, intrinsics: Intrinsics) -> tuple[SlamConfiguration, ...]:
        """The configurations for frames of ``intrinsics``."""
        if self.configurations is None:
            return default_configurations(intrinsics)
        return tuple(self.configurations)

    def costs_of(self, intrinsics: Intrinsics) -> tuple[float, ...]:
        """Cost (K,) of each configuration for frames of ``intrinsics``.

        Raises:
            InputError: neither ``costs`` nor the configurations specify it.
        """
        if self.costs is not None:
            return self.costs
        named = [one.about.get("cost") for one in self.resolved(intrinsics)]
        if None in named:
            raise InputError(
                f"configurations[{named.index(None)}] has no about.cost, and no costs are given"
            )
        return rising(named, "about.cost of the configurations", len(named))

    @abstractmethod
    def make_controller(self, intrinsics: Intrinsics) -> Controller:
        """Make the controller that chooses a configuration."""

    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """Make ``backend`` switch between configurations; see ``AdaptiveSlam``."""
        levels = make_levels(self.resolved(backend.intrinsics), backend)
        return AdaptiveSlam(backend, levels, self.make_controller(backend.intrinsics), drops_frames)


@dataclass(frozen=True)
class DivergenceAdaptationConfig(SwitchingConfig):
    """Chooses a more robust configuration for more divergence between frames, with hysteresis.

    Attributes:
        thresholds: K - 1 increasing values. If the change between consecutive frames exceeds the
            i-th, configuration i is not good enough; it switches up at once, as far as needed.
        release_share: share of a threshold, in (0, 1], that the change must fall below to switch
            down.
        dwell_frames: number of recent frames whose largest change limits how far it switches down.
        levels: file written by a design-space exploration, whose configurations, thresholds and
            costs replace these; reset to None once read.
        per: measure the change per ``frame`` or, by the time stamps, per ``second``.
        change: how the change between frames is measured.

    Raises:
        InputError: the number of thresholds is not that of configurations minus one, they do not
            increase, or a value is out of range.
    """

    name: str = field(default="divergence", init=False)
    thresholds: tuple[float, ...] = (0.004, 0.01)
    release_share: float = bounded(0.7, 0.001, 1)
    dwell_frames: int = bounded(6, 1, 1_000_000)
    per: str = chosen("frame", "frame", "second")
    change: ChangeConfig = field(default_factory=ChangeConfig)
    levels: str | Path | None = None

    def __post_init__(self) -> None:
        if self.levels is not None:
            self._take(self.levels)
        super().__post_init__()
        wanted = self.num_configurations - 1
        object.__setattr__(self, "thresholds", rising(self.thresholds, "thresholds", wanted))

    def _take(self, levels: str | Path) -> None:
        """Read configurations, thresholds and costs from a file."""
        if self.configurations is not None:
            raise InputError("levels and configurations both say what to switch among; give one")
        found = read_levels(levels, "adaptation")
        for name in ("configurations", "thresholds", "costs"):
            object.__setattr__(self, name, found.get(name))
        object.__setattr__(self, "levels", None)

    def make_controller(self, intrinsics: Intrinsics) -> Controller:
        """Make the controller for frames of ``intrinsics``."""
        return DivergenceController(self, intrinsics)


class DivergenceController(Saved, Controller):
    """Switches up at once, and down after a number of frames below the threshold.

    Attributes:
        change: change between the last two frames, nats or nats per second; 0 before the second
            frame.
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
        self._recent: list[float] = []  # changes of the last ``dwell_frames`` frames

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return super().state_like() | {
            "time_s": OrNone(0.0),
            "index": WholeNumber(most=len(self._config.thresholds)),
            "recent": ListOf(Real(least=0), self._config.dwell_frames),
        }

    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """Choose by the change from the frame before."""
        is_first = self._time_s is None
        self._observe(frame)
        if is_first:
            return self.index
        config = self._config
        change = inf if is_lost else self.change
        self._recent = [*self._recent, change][-config.dwell_frames :]
        self.index = max(self.index, bisect_right(config.thresholds, change))
        if len(self._recent) == config.dwell_frames:
            self.index = min(self.index, bisect_right(self._release, max(self._recent)))
        return self.index

    def _observe(self, frame: RGBDFrame) -> None:
        """Measure the change from the frame before; this frame is the next reference."""
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
    """The agent chooses the configuration with ``AdaptiveSlam.use(index)``."""

    name: str = field(default="agent", init=False)

    def make_controller(self, intrinsics: Intrinsics) -> Controller:
        """Make a controller that obeys ``use``."""
        return AgentController(self.num_configurations, self.first)


class AgentController(Saved, Controller):
    """Keeps the configuration set last by ``use``."""

    saved = ("index",)

    def __init__(self, count: int, first: int) -> None:
        self._count, self._first = count, first
        self.reset()

    def reset(self) -> None:
        """Return to the first configuration."""
        self.index = self._first

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return {"index": WholeNumber(most=self._count - 1)}

    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """Return the index set last."""
        return self.index

    def use(self, index: int) -> None:
        """Use configuration ``index`` from the next frame on."""
        if not 0 <= index < self._count:
            raise InputError(f"configuration {index!r} is outside [0, {self._count - 1}]")
        self.index = int(index)
