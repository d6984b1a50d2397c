"""Pareto fronts of finished trials: which trials, how much they dominate, and which to choose."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.exploration.study_storage import StudyStorage

Float64 = NDArray[np.float64]


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


def choose(points: Sequence[Point], objectives: Sequence[str]) -> dict[str, Point]:
    """Points of the front by purpose, of the first two objectives (error, cost).

    ``fastest``: the least cost whose error is not above the default's; ``most_accurate``: the least
    error whose cost is not above the default's; ``knee``: farthest below the line between the two
    ends of the front, on logarithmic axes. Without a default that finished well, only the knee.
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

    On logarithmic axes, each scaled to the front's extent: "farthest" then means the same whatever
    the units are.
    """
    logs = np.log(np.maximum(np.asarray(values, dtype=np.float64), 1e-12))
    extent = np.ptp(logs, axis=0)
    if len(logs) < 3 or not np.all(extent > 0):
        return int(np.argmin(logs.sum(axis=1)))
    scaled = (logs - logs.min(axis=0)) / extent
    return int(np.argmin(scaled.sum(axis=1)))


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
