"""Pareto fronts of finished trials, and the volume they dominate."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.tuning.objectives import METRICS, on_front
from ms_slam_env.tuning.study_storage import StudyStorage


@dataclass(frozen=True)
class Point:
    """A finished trial.

    Attributes:
        number: number of the trial.
        params: values of the parameters.
        measured: everything that the evaluation returned.
        values: objective values as passed to the sampler.
        feasible: whether it did not fail and met every constraint.
        on_front: whether every objective is better than the reference, and no feasible trial is
            at least as good in every objective and better in one.
        is_default: whether it is the configuration that the exploration started from.
    """

    number: int
    params: dict[str, Any]
    measured: dict[str, Any]
    values: tuple[float, ...]
    feasible: bool
    on_front: bool
    is_default: bool


def points_of(storage: StudyStorage) -> list[Point]:
    """The finished trials, in the order of their numbers."""
    reference = storage.reference() or {}  # none before the first trial has finished
    limits = [reference.get(name, math.inf) for name in storage.settings.objectives]
    best = {
        trial.number
        for trial in storage.study.best_trials
        if all(value < limit for value, limit in zip(trial.values, limits, strict=True))
    }
    defaults = storage.space.defaults()
    return [
        Point(
            trial.number,
            dict(trial.params),
            dict(trial.user_attrs["measured"]),
            tuple(trial.values),
            all(value <= 0 for value in trial.constraints.values()),
            trial.number in best,
            trial.params == defaults,
        )
        for trial in storage.finished()
    ]


def front_of(points: Sequence[Point], metrics: Sequence[str]) -> list[Point]:
    """Those of ``points`` that none beats in ``metrics``, sorted by the last metric."""
    known = [p for p in points if all(p.measured.get(name) is not None for name in metrics)]
    told = [[METRICS[name].told(p.measured[name]) for name in metrics] for p in known]
    unbeaten = on_front(np.array(told).reshape(len(known), len(metrics)))
    best = [p for p, is_best in zip(known, unbeaten, strict=True) if is_best]
    return sorted(best, key=lambda point: float(point.measured[metrics[-1]]))


def hypervolume_history(
    points: Sequence[Point], reference: Mapping[str, float], objectives: Sequence[str]
) -> Float64:
    """(n,) share of the box from 0 to the reference dominated by feasible points so far.

    Zitzler and Thiele's hypervolume divided by the volume of the box; it never decreases.
    """
    corner = np.array([reference[name] for name in objectives])
    history = np.zeros(len(points))
    kept = np.zeros((0, len(corner)))
    for index, point in enumerate(points):
        if point.feasible:
            kept = np.vstack([kept, np.array(point.values) / corner])
        history[index] = hypervolume(kept, np.ones(len(corner)))
    return history


def hypervolume(values: ArrayLike, reference: ArrayLike) -> float:
    """Volume dominated by points (n, d) up to ``reference`` (d,); smaller values are better."""
    from optuna._hypervolume import compute_hypervolume

    points = np.asarray(values, dtype=np.float64)
    corner = np.asarray(reference, dtype=np.float64)
    inside = points[np.all(points < corner, axis=-1)] if len(points) else points
    return float(compute_hypervolume(inside, corner)) if len(inside) else 0.0


def importances(storage: StudyStorage) -> dict[str, dict[str, float]]:
    """Importance of each parameter for good values of each objective, as shares.

    Uses PED-ANOVA (Watanabe, Bansal, Hutter, IJCAI 2023). Empty if there are too few trials.
    """
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    def target(index: int) -> Any:
        return lambda trial: trial.values[index]

    found = {}
    for index, name in enumerate(storage.settings.objectives):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # low values are good, as intended
                shares = get_param_importances(
                    storage.study, evaluator=PedAnovaImportanceEvaluator(), target=target(index)
                )
        except (RuntimeError, ValueError):
            continue
        if all(math.isfinite(share) for share in shares.values()):
            found[name] = {key: float(share) for key, share in shares.items()}
    return found
