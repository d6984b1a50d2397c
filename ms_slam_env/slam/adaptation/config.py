"""What the configurations of run-time adaptation have in common, and none."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Checked, Family, check_range
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation.adaptive_slam import (
    AdaptiveSlam,
    Controller,
    as_configurations,
    default_configurations,
    make_levels,
)
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.configuration import SlamConfiguration


def rising(values: Any, name: str, count: int) -> tuple[float, ...]:
    """``count`` positive numbers, each larger than the one before, as a tuple.

    Raises:
        InputError: they are something else.
    """
    is_list = isinstance(values, (tuple, list))
    numbers = [x for x in values if isinstance(x, (int, float))] if is_list else []
    is_rising = all(a < b for a, b in itertools.pairwise([0, *numbers]))
    if not is_rising or not is_list or not len(numbers) == len(values) == count:
        raise InputError(f"{name} = {values!r} must be {count} positive numbers that rise")
    return tuple(float(x) for x in numbers)


@dataclass(frozen=True)
class AdaptationConfig(Checked, Family, ABC):
    """How a running SLAM changes its configuration: Saeedi et al., ICRA 2017, section V-B.

    Made from a mapping: ``from_dict(AdaptationConfig, {"name": "divergence", ...})``.
    """

    @abstractmethod
    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """``backend`` with this adaptation; ``keep_every`` counts only if it ``drops_frames``.

        Raises:
            InputError: a backend or a configuration that cannot change while SLAM runs.
        """


@dataclass(frozen=True)
class NoAdaptationConfig(AdaptationConfig):
    """The configuration stays as it is."""

    name: str = field(default="none", init=False)

    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """The backend as it is."""
        return backend


@dataclass(frozen=True)
class SwitchingConfig(AdaptationConfig):
    """Of what switches among configurations.

    Attributes:
        configurations: from fast to robust, at least two: YAML files of ``SlamConfiguration``,
            mappings of its fields, or such objects. What one does not name stays as the backend
            was made. None: three that suit the camera (``default_configurations``).
        start: index of the first in force; None: the last, the most robust.
        costs: of each configuration, rising and positive: a stand-in for processor time that is
            the same in every run. None: ``about.cost`` of each configuration.

    Raises:
        InputError: a bad configuration, an index that none has, or bad costs.
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
        """K, how many take turns."""
        return 3 if self.configurations is None else len(self.configurations)

    @property
    def first(self) -> int:
        """Index of the first configuration in force."""
        return self.num_configurations - 1 if self.start is None else self.start

    def resolved(self, intrinsics: Intrinsics) -> tuple[SlamConfiguration, ...]:
        """The configurations for frames of ``intrinsics``."""
        if self.configurations is None:
            return default_configurations(intrinsics)
        return tuple(self.configurations)

    def costs_of(self, intrinsics: Intrinsics) -> tuple[float, ...]:
        """(K,) the cost of each configuration for frames of ``intrinsics``.

        Raises:
            InputError: neither ``costs`` nor the configurations say it.
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
        """What chooses among them."""

    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """``backend`` that switches; see ``AdaptiveSlam``."""
        levels = make_levels(self.resolved(backend.intrinsics), backend)
        return AdaptiveSlam(backend, levels, self.make_controller(backend.intrinsics), drops_frames)
