"""A threshold that follows a budget."""

from __future__ import annotations

import math


class ThresholdController:
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
