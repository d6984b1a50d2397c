"""A study that is kept nowhere: what an experiment runs many of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ms_slam_env.exploration.objectives import FAILURE, METRICS, Measured, objective_values
from ms_slam_env.exploration.samplers import make_sampler
from ms_slam_env.exploration.space import SearchSpace

_POPULATION = 10  # of NSGA-II: several generations within a budget of tens


def explore_in_memory(
    space: SearchSpace,
    measure: Callable[[Mapping[str, Any]], Measured],
    objectives: Sequence[str],
    sampler: str,
    seed: int,
    trials: int,
    reference: Mapping[str, float] | None = None,
) -> list[tuple[dict[str, Any], Measured]]:
    """So many trials, the default first.

    Args:
        space: the parameters.
        measure: values of the parameters in, what was measured out.
        objectives: names in ``METRICS``, two or more.
        sampler: name in ``SAMPLERS``.
        seed: of the sampler.
        trials: how many.
        reference: where each objective stops to count; None for the worst there is.

    Returns:
        the values of the parameters and what was measured, trial by trial.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    limits = reference or {name: METRICS[name].worst for name in objectives}
    study = optuna.create_study(
        directions=["minimize"] * len(objectives),
        sampler=make_sampler(sampler, seed, _POPULATION),
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
