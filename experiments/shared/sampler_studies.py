"""Compare samplers in memory, on a grid whose points are measured only once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.errors import InputError
from ms_slam_env.report.records import RecordFile, spec_key
from ms_slam_env.tuning.evaluator import Row, SlamEvaluator
from ms_slam_env.tuning.objectives import FAILURE, METRICS, Measured, objective_values
from ms_slam_env.tuning.parameters import Float, Integer
from ms_slam_env.tuning.samplers import make_sampler
from ms_slam_env.tuning.space import SearchSpace


@dataclass(frozen=True)
class _Point:
    """A point of the grid with everything that determines its measurement."""

    evaluator: SlamEvaluator
    base: dict[str, Any]
    values: dict[str, Any]


class Grid:
    """Measures the grid point closest to the requested values; each point only once.

    Args:
        space: ranges, without choices.
        evaluator: measures a point.
        count: points along each parameter, including the default; ranges of integers may have
            fewer.
        path: file of the measurements.

    Raises:
        InputError: a parameter without an order.
    """

    def __init__(
        self, space: SearchSpace, evaluator: SlamEvaluator, count: int, path: Path
    ) -> None:
        self.space, self.evaluator = space, evaluator
        self.levels = {name: _levels(space, name, count) for name in space.parameters}
        self._records = RecordFile(path)
        self._known = self._records.load()

    def nearest(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The grid point closest to ``values``, by ratio on logarithmic ranges."""
        point = {}
        for name, value in values.items():
            levels = np.array([*self.levels[name], value], dtype=np.float64)
            scaled = np.log(levels) if _range(self.space, name).log else levels
            point[name] = self.levels[name][int(np.argmin(np.abs(scaled[:-1] - scaled[-1])))]
        return point

    def __call__(self, values: Mapping[str, Any]) -> Row:
        """Measurement at the grid point closest to ``values``."""
        point = self.nearest(values)
        key = spec_key(_Point(self.evaluator, asdict(self.space.base), point))
        if key not in self._known:
            row = {"key": key, "params": point, **self.evaluator(self.space.configuration(point))}
            self._records.append(row)
            self._known[key] = row
        return self._known[key]

    @property
    def measured(self) -> int:
        """Number of points measured so far."""
        return len(self._known)

    @property
    def size(self) -> int:
        """Number of points of the grid."""
        return int(np.prod([len(levels) for levels in self.levels.values()]))


def _levels(space: SearchSpace, name: str, count: int) -> list[Any]:
    """Values of a parameter in order; the one closest to the default is replaced by it."""
    kind = _range(space, name)
    default = space.defaults()[name]
    spaced = (np.geomspace if kind.log else np.linspace)(kind.low, kind.high, count)
    values = [round(v) if isinstance(kind, Integer) else float(v) for v in spaced]
    scaled = np.log([*values, default]) if kind.log else np.array([*values, default])
    values[int(np.argmin(np.abs(scaled[:-1] - scaled[-1])))] = default
    return sorted(set(values))


def _range(space: SearchSpace, name: str) -> Float | Integer:
    kind = space.parameters[name]
    if not isinstance(kind, (Float, Integer)):
        raise InputError(f"parameter {name!r} has no order, which a grid needs")
    return kind


_POPULATION = 10  # of NSGA-II, for several generations within tens of trials


def explore_in_memory(
    space: SearchSpace,
    measure: Callable[[Mapping[str, Any]], Measured],
    objectives: Sequence[str],
    sampler: str,
    seed: int,
    trials: int,
    reference: Mapping[str, float] | None = None,
) -> list[tuple[dict[str, Any], Measured]]:
    """Run ``trials`` trials, the default first.

    Args:
        space: the parameters.
        measure: function from parameter values to measurements.
        objectives: names in ``METRICS``, two or more.
        sampler: name in ``SAMPLERS``.
        seed: seed of the sampler.
        trials: number of trials.
        reference: largest value of each objective that counts; None for the worst possible.

    Returns:
        parameter values and measurements of each trial.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    limits = reference or {name: METRICS[name].worst for name in objectives}
    study = optuna.create_study(
        directions=["minimize"] * len(objectives), sampler=make_sampler(sampler, seed, _POPULATION)
    )
    study.enqueue_trial(space.defaults())
    found = []
    for _ in range(trials):
        trial = study.ask(space.distributions())
        measured = measure(trial.params)
        trial.set_constraint("failed", 1.0 if measured.get(FAILURE) else 0.0)
        study.tell(trial, objective_values(measured, objectives, limits))
        found.append((trial.params, measured))
    return found
