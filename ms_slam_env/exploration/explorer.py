"""Explore until enough trials have finished: here, in processes, or on Ray."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ms_slam_env.errors import InputError
from ms_slam_env.exploration.ledger import Ledger
from ms_slam_env.exploration.ray_workers import explore_on_ray
from ms_slam_env.exploration.settings import Evaluate, ExplorationSettings
from ms_slam_env.exploration.space import SearchSpace
from ms_slam_env.exploration.workers import explore_here, explore_in_processes

Progress = Callable[[int], None]


def explore(
    folder: Path,
    space: SearchSpace,
    settings: ExplorationSettings,
    evaluate: Evaluate,
    budget: int,
    workers: int = 1,
    ray_address: str | None = None,
    progress: Progress | None = None,
) -> Ledger:
    """Go on with the study in ``folder``, or begin it, until ``budget`` trials have finished.

    It may be killed at any moment and called again: what had finished is kept, what was running
    is marked as failed and done again. Calls in several processes share the work.

    Args:
        folder: of the study.
        space: the parameters.
        settings: of the exploration.
        evaluate: measures a configuration.
        budget: finished trials, those of earlier calls included.
        workers: processes; with Ray, evaluations at the same time.
        ray_address: of a Ray cluster; ``local`` for one on this machine that lives as long as the
            call; None for no Ray.
        progress: called now and then with the number of finished trials.

    Raises:
        InputError: bad input, or a folder with another study.
        RuntimeError: worker processes die again and again.
    """
    if isinstance(budget, bool) or budget < 1 or workers < 1:
        name, value = ("trials", budget) if budget < 1 else ("workers", workers)
        raise InputError(f"{name} = {value} must be at least 1")
    ledger = Ledger(folder, space, settings)
    report = progress or _silent
    if ray_address is not None:
        explore_on_ray(ledger, evaluate, budget, ray_address, workers, report)
    elif workers > 1:
        explore_in_processes(ledger, evaluate, budget, workers, report)
    else:
        explore_here(ledger, evaluate, budget, report)
    return ledger


def _silent(finished: int) -> None:
    """Report nothing."""
