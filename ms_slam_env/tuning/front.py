"""Pareto fronts of finished trials: which trials, and how much they dominate."""

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
        number: of the trial.
        params: values of the parameters.
        measured: everything that the evaluation returned.
        values: of the objectives, as the sampler was told.
        feasible: it did not fail and kept every constraint.
        on_front: no feasible trial is as good in every objective and better in one, and every
            objective is better than the reference.
        is_default: it is the configuration that the exploration started from.
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
    """Those of ``points`` that none beats in ``metrics``, in the order of the last of them."""
    known = [p for p in points if all(p.measured.get(name) is not None for name in metrics)]
    told = [[METRICS[name].told(p.measured[name]) for name in metrics] for p in known]
    unbeaten = on_front(np.array(told).reshape(len(known), len(metrics)))
    best = [p for p, is_best in zip(known, unbeaten, strict=True) if is_best]
    return sorted(best, key=lambda point: float(point.measured[metrics[-1]]))


def hypervolume_history(
    points: Sequence[Point], reference: Mapping[str, float], objectives: Sequence[str]
) -> Float64:
    """(n,) share of the box from 0 to the reference that the feasible among the first k dominate.

    Zitzler and Thiele's hypervolume, over that of the box; it never falls.
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
    """Volume of what points (n, d) dominate up to ``reference`` (d,); smaller is better."""
    from optuna._hypervolume import compute_hypervolume

    points = np.asarray(values, dtype=np.float64)
    corner = np.asarray(reference, dtype=np.float64)
    inside = points[np.all(points < corner, axis=-1)] if len(points) else points
    return float(compute_hypervolume(inside, corner)) if len(inside) else 0.0


def importances(storage: StudyStorage) -> dict[str, dict[str, float]]:
    """Share of each parameter in what makes a good value, by objective.

    PED-ANOVA (Watanabe, Bansal, Hutter, IJCAI 2023). Empty while there are too few trials.
    """
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    def target(index: int) -> Any:
        return lambda trial: trial.values[index]

    found = {}
    for index, name in enumerate(storage.settings.objectives):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that low values are taken as good: they are
                shares = get_param_importances(
                    storage.study, evaluator=PedAnovaImportanceEvaluator(), target=target(index)
                )
        except (RuntimeError, ValueError):
            continue
        if all(math.isfinite(share) for share in shares.values()):
            found[name] = {key: float(share) for key, share in shares.items()}
    return found
