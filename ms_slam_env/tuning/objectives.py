"""Objectives and constraints of an exploration, and the values of a failed evaluation."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env.errors import InputError, unknown

Measured = Mapping[str, Any]


@dataclass(frozen=True)
class Metric:
    """A quantity that an evaluation measures.

    Attributes:
        key: key in the metric registry, used in results.
        worst: value used if nothing better is known, as passed to samplers.
        is_error: whether it is meaningless for a run that lost track.
        wall_key: key instead of ``key`` if time is measured by the clock.
        scale: factor from the objective's unit to the registry's.
        is_larger_better: whether larger is better. Since all objectives are minimised, samplers
            receive the reciprocal, which does not change the Pareto front.
    """

    key: str
    worst: float
    is_error: bool
    wall_key: str = ""
    scale: float = 1.0
    is_larger_better: bool = False

    def told(self, value: float) -> float:
        """Convert ``value`` to the form passed to samplers (less is better), or back."""
        if not self.is_larger_better:
            return value
        return 1.0 / value if value > 0 else self.worst


METRICS: dict[str, Metric] = {
    "ate_m": Metric("ate_m", 1.0, True),
    "ate_max_m": Metric("ate_max_m", 1.0, True),
    "ext_ms": Metric("cpu_ms_median", 1e3, False, "ext_ms_median"),
    "load_ms": Metric("load_cpu_ms", 1e3, False, "load_ext_ms"),
    "mem_mb": Metric("mem_peak_mb", 1e5, False),
    "energy_j": Metric("ene_frame_j", 1e3, False),
    "energy_model_j": Metric("ene_model_frame_j", 1e3, False),
    "map_error_mm": Metric("map_error_median_m", 1e3, True, scale=1e-3),
    "lost": Metric("lost_share", 1.0, False),
    "ate_worst_m": Metric("worst_ate_m", 1.0, True),
    "ate_worst_ratio": Metric("worst_ate_ratio", 1e3, True),
    "M_I": Metric("M_I", 1e6, True, is_larger_better=True),
    "M_D": Metric("M_D", 1e6, True, is_larger_better=True),
}
"""Metrics that an evaluation can measure. An exploration minimises them, except for the divergences
M_I and M_D (equations 11 and 12) that a configuration copes with, which it maximises."""

FAILURE = "failure"
"""Key of an evaluation's text that says why it measured less than it should."""


OTHERS = ("ate_tracked_m", "tracked_share", "largest_change", "frames", FAILURE)
"""Further keys that an evaluation may return, with the registry's names."""


def key_of(name: str, clock: str) -> str:
    """Registry key of metric ``name`` if time is measured by ``clock``, processor or wall."""
    metric = METRICS[name]
    return (clock == "wall" and metric.wall_key) or metric.key


def as_metrics(measured: Measured, clock: str) -> dict[str, Any]:
    """Results of an evaluation with the registry's keys and units; None if unknown."""
    found: dict[str, Any] = {}
    for name, metric in METRICS.items():
        if name in measured:
            value = measured[name]
            found[key_of(name, clock)] = None if value is None else metric.scale * value
    return found | {name: measured[name] for name in OTHERS if name in measured}


@dataclass(frozen=True)
class Constraint:
    """``metric`` must not exceed ``limit`` or, with ``at_least``, must not be below it."""

    metric: str
    limit: float
    at_least: bool = False

    def __str__(self) -> str:
        return f"{self.metric}{'>' if self.at_least else '<'}{repr(self.limit).removesuffix('.0')}"

    def violation(self, measured: Measured) -> float:
        """Violation of the constraint relative to the limit; 0 or less if it is met.

        A value that was not measured counts as the worst value.
        """
        value = measured.get(self.metric)
        if value is None or not math.isfinite(value):
            value = 0.0 if self.at_least else METRICS[self.metric].worst
        excess = self.limit - value if self.at_least else value - self.limit
        return float(excess / (abs(self.limit) or 1.0))


def parse_constraint(text: str) -> Constraint:
    """Parse ``metric<limit``; for M_I and M_D, which say how hard a sequence is, also ``>``.

    Raises:
        InputError: malformed text, or an unknown metric.
    """
    name, sign, limit = [*re.split("([<>])=?", text, maxsplit=1), "", ""][:3]
    name = name.strip()
    known = METRICS.get(name)
    if not sign or (sign == ">" and known is not None and not known.is_larger_better):
        raise InputError(
            f"constraint {text!r} is not metric<limit, as in ate_m<0.01, nor M_I>limit or M_D>limit"
        )
    if known is None:
        raise unknown("metric of a constraint", name, METRICS)
    try:
        number = float(limit)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (sign == ">" and number <= 0):
        raise InputError(
            f"constraint {text!r}: {limit.strip()!r} is not a {'positive ' * (sign == '>')}number"
        )
    return Constraint(name, number, sign == ">")


def objective_values(
    measured: Measured, objectives: Sequence[str], reference: Mapping[str, float]
) -> list[float]:
    """Value of each objective for the sampler: finite, and at most ``reference`` in the same form.

    In a failed run, all errors count as the reference, since the trajectory of a lost camera may be
    close to the true one by chance. Measured costs still count, because a sampler can learn from
    them.
    """
    failed = bool(measured.get(FAILURE))
    values = []
    for name in objectives:
        value = measured.get(name)
        if value is None or not math.isfinite(value) or (failed and METRICS[name].is_error):
            values.append(reference[name])
        else:
            values.append(min(METRICS[name].told(float(value)), reference[name]))
    return values


def on_front(values: Float64) -> Bool:
    """Mask (n,) of the ``values`` (n, d) that no other beats: none is <= in all and < in one."""
    beaten = [
        np.any(np.all(values <= own, axis=1) & np.any(values < own, axis=1)) for own in values
    ]
    return ~np.array(beaten, dtype=np.bool_)
