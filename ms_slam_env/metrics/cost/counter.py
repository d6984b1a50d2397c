"""What counts energy, and what stands where nothing does."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod


class EnergyCounter(ABC):
    """Energy that a part of the machine has taken.

    Attributes:
        source: of the figures, in words.
        reason: why there are none; empty while there are.
    """

    source: str = ""
    reason: str = ""

    @abstractmethod
    def joules(self) -> float:
        """Energy in joules since this counter was made; NaN once ``reason`` says why."""


class NoEnergy(EnergyCounter):
    """Counts nothing, because there is nothing to read.

    Args:
        reason: why.
    """

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def joules(self) -> float:
        """NaN."""
        return math.nan
