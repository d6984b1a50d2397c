"""Choose trials of a study by purpose, for a divergence, or as levels of adaptation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation.adaptive_slam import MOST
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning.front import Point
from ms_slam_env.tuning.objectives import METRICS

COST = "ext_ms"
"""Cost of a level, or of the configuration for a divergence: the time of a processed frame."""
CHANGE = "largest_change"
"""Divergence that a level was measured at, as measured by adaptation and frame selection."""


def choose(points: Sequence[Point], objectives: Sequence[str]) -> dict[str, Point]:
    """Points of the front by purpose, for the first two objectives (error, cost).

    ``fastest``: lowest cost with an error of at most the default's; ``most_accurate``: lowest error
    with a cost of at most the default's; ``knee``: farthest below the line between the two ends of
    the front, on logarithmic axes. If the default failed, only the knee.
    """
    front = sorted((p for p in points if p.on_front), key=lambda point: point.values)
    if not front:
        return {}
    chosen: dict[str, Point] = {}
    default = next((point for point in points if point.is_default and point.feasible), None)
    if default is not None:
        error, cost = default.values[:2]
        chosen["fastest"] = min(
            (p for p in front if p.values[0] <= error), key=lambda p: p.values[1], default=default
        )
        chosen["most_accurate"] = min(
            (p for p in front if p.values[1] <= cost), key=lambda p: p.values[0], default=default
        )
    chosen["knee"] = front[knee([point.values[:2] for point in front])]
    return chosen


def knee(values: ArrayLike) -> int:
    """Index of the point of a front (n, 2) that lies farthest below the line between its ends.

    Axes are logarithmic and scaled to the front's extent, so that units do not matter.
    """
    logs = np.log(np.maximum(np.asarray(values, dtype=np.float64), 1e-12))
    extent = np.ptp(logs, axis=0)
    if len(logs) < 3 or not np.all(extent > 0):
        return int(np.argmin(logs.sum(axis=1)))
    scaled = (logs - logs.min(axis=0)) / extent
    return int(np.argmin(scaled.sum(axis=1)))


@dataclass(frozen=True)
class Limit:
    """Largest acceptable error of a trial: ``tolerance`` times the default's.

    Attributes:
        objective: name of the error metric.
        value: largest acceptable value; infinite if the default failed.
    """

    objective: str
    value: float

    @classmethod
    def of(cls, points: Sequence[Point], objectives: Sequence[str], tolerance: float) -> Limit:
        """The limit of a study's first objective."""
        sound = [point for point in points if point.is_default and point.feasible]
        value = tolerance * error_of(sound[0], objectives[0]) if sound else math.inf
        return cls(objectives[0], value)

    def holds(self, point: Point) -> bool:
        """Whether ``point`` is feasible, has a measured time, and is good enough."""
        error = error_of(point, self.objective)
        return point.feasible and _has(point, COST) and error <= self.value


def error_of(point: Point, objective: str) -> float:
    """Error as passed to samplers, but not capped at the reference; infinite if unknown."""
    value = point.measured.get(objective)
    return math.inf if value is None else METRICS[objective].told(value)


def _has(point: Point, *names: str) -> bool:
    return all(point.measured.get(name) is not None for name in names)


def for_divergence(points: Sequence[Point], M_I: float, M_D: float, limit: Limit) -> Point:
    """The trial to use for divergences of up to (M_I, M_D), nats, between processed frames.

    Considers the feasible trials that were measured at such divergences or larger ones. Returns the
    one within ``limit`` whose processed frame takes the least time or, if none is within, the one
    with the lowest error.

    Raises:
        InputError: no trial was measured at such divergences.
    """
    known = [p for p in points if p.feasible and _has(p, COST, "M_I", "M_D")]
    hard = [p for p in known if p.measured["M_I"] >= M_I and p.measured["M_D"] >= M_D]
    if not hard:
        most = [max((p.measured[name] for p in known), default=0.0) for name in ("M_I", "M_D")]
        raise InputError(
            f"no feasible trial was measured at M_I >= {M_I:g} and M_D >= {M_D:g}: the largest are "
            f"{most[0]:.3g} and {most[1]:.3g}; explore keep_every, or harder sequences"
        )
    good = [p for p in hard if limit.holds(p)]
    if good:
        return min(good, key=lambda p: p.measured[COST])
    return min(hard, key=lambda p: error_of(p, limit.objective))


def levels_of(points: Sequence[Point], limit: Limit) -> list[Point]:
    """Trials within ``limit`` that none beats in both time and divergence, from fast to robust.

    Run-time adaptation switches among them (section V-B of the paper): each is the fastest for
    divergences up to the one it was measured at.
    """
    good = [p for p in points if limit.holds(p) and _has(p, CHANGE)]
    levels: list[Point] = []
    for point in sorted(good, key=lambda p: (p.measured[COST], -p.measured[CHANGE])):
        if not levels or point.measured[CHANGE] > levels[-1].measured[CHANGE]:
            levels.append(point)
    return levels[-MOST:]


def as_options(
    levels: Sequence[Point], made: Sequence[SlamConfiguration], points: Sequence[Point]
) -> dict[str, Any]:
    """Options of run-time adaptation and frame selection from a study's levels.

    With adaptation, every frame is processed, and a level is activated when the change between
    frames exceeds the one that the previous level was measured at. A filter instead drops frames
    until the change reaches the one that the last level was measured at, minus the change that one
    more frame may add: the largest between consecutive frames of the study.

    Args:
        levels: result of ``levels_of``.
        made: their configurations.
        points: all points of the study.
    """
    changes = [point.measured[CHANGE] for point in points if _has(point, CHANGE)]
    found: dict[str, Any] = {}
    if len(levels) > 1:
        found["adaptation"] = {
            "configurations": [asdict(one) for one in made],
            "thresholds": [point.measured[CHANGE] for point in levels[:-1]],
            "costs": [point.measured[COST] for point in levels],
        }
    if levels and levels[-1].measured[CHANGE] > min(changes):
        found["frame_management"] = {"threshold": levels[-1].measured[CHANGE] - min(changes)}
    return found
