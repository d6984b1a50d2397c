"""Kinds of parameters and their allowed values."""

from __future__ import annotations

import numbers
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution


class Parameter(ABC):
    """Set of values that a parameter may take."""

    @abstractmethod
    def distribution(self) -> BaseDistribution:
        """What Optuna draws from."""

    @abstractmethod
    def contains(self, value: Any) -> bool:
        """Whether ``value`` is one of them."""

    @abstractmethod
    def ends(self) -> tuple[Any, ...]:
        """The extreme values, or all values if they have no order."""

    @abstractmethod
    def __str__(self) -> str:
        """The values in words."""


@dataclass(frozen=True)
class _Range(Parameter):
    """Numbers from ``low`` to ``high``, both included; ``log``: equal ratios are equally likely.

    Raises:
        InputError: an empty range, or a logarithmic one that is not positive.
    """

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        """Refuse an empty or invalid range."""
        if not self.low < self.high or (self.log and not self.low > 0):
            raise InputError(f"range {self.low}:{self.high} holds no values")

    def ends(self) -> tuple[Any, ...]:
        """The extreme values."""
        return self.low, self.high

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}" + (", logarithmic" if self.log else "")


@dataclass(frozen=True)
class Float(_Range):
    """Real numbers."""

    def distribution(self) -> BaseDistribution:
        """What Optuna draws from."""
        from optuna.distributions import FloatDistribution

        return FloatDistribution(self.low, self.high, log=self.log)

    def contains(self, value: Any) -> bool:
        """Whether ``value`` is one of them."""
        return _is_number(value, numbers.Real) and self.low <= value <= self.high


@dataclass(frozen=True)
class Integer(_Range):
    """Integers."""

    def distribution(self) -> BaseDistribution:
        """What Optuna draws from."""
        from optuna.distributions import IntDistribution

        return IntDistribution(int(self.low), int(self.high), log=self.log)

    def contains(self, value: Any) -> bool:
        """Whether ``value`` is one of them."""
        return _is_number(value, numbers.Integral) and self.low <= value <= self.high


@dataclass(frozen=True)
class Choice(Parameter):
    """One of several values, without order.

    Raises:
        InputError: fewer than two values, or a value given twice.
    """

    values: tuple[Any, ...]

    def __post_init__(self) -> None:
        """Refuse fewer than two values, and duplicates."""
        if len(self.values) < 2 or len(set(map(repr, self.values))) < len(self.values):
            raise InputError(f"values {self} must be two or more, each once")

    def distribution(self) -> BaseDistribution:
        """What Optuna draws from."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution(self.values)

    def contains(self, value: Any) -> bool:
        """Whether ``value`` is one of them."""
        return value in self.values

    def ends(self) -> tuple[Any, ...]:
        """All values."""
        return self.values

    def __str__(self) -> str:
        return ", ".join(map(str, self.values))


def _is_number(value: Any, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool)
