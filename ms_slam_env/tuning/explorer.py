"""Explore until enough trials have finished: here, in processes, or on Ray."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ms_slam_env._runtime.interrupts import kept, recorded
from ms_slam_env._runtime.parallel import Outcome, Pool, open_pool
from ms_slam_env.errors import InputError
from ms_slam_env.tuning.settings import Evaluate, ExplorationSettings
from ms_slam_env.tuning.space import SearchSpace
from ms_slam_env.tuning.study_storage import StudyStorage

if TYPE_CHECKING:
    from optuna import Trial

Progress = Callable[[int], None]

_MOST_DEATHS = 5  # of workers without a trial that finished in between


def explore(
    folder: Path,
    space: SearchSpace,
    settings: ExplorationSettings,
    evaluate: Evaluate,
    budget: int,
    workers: int = 1,
    ray_address: str | None = None,
    progress: Progress | None = None,
) -> StudyStorage:
    """Go on with the study in ``folder``, or begin it, until ``budget`` trials have finished.

    It may be killed at any moment and called again: what had finished is kept, what was running
    is marked as failed and done again. Calls in several processes share the work
    (``ms-slam explore`` has its folder to itself, and processes by ``--workers``).

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
        RuntimeError: worker processes die again and again, or an evaluation raised something else.
    """
    if isinstance(budget, bool) or budget < 1 or workers < 1:
        name, value = ("trials", budget) if budget < 1 else ("workers", workers)
        raise InputError(f"{name} = {value} must be at least 1")
    storage = StudyStorage(folder, space, settings)
    report = progress or (lambda finished: None)
    with kept(f"finished trials are kept in {folder}; the same command goes on"):
        if workers == 1 and ray_address is None:
            _explore_here(storage, evaluate, budget, report)
        else:
            with open_pool(evaluate, workers, ray_address) as pool:
                _explore_with(pool, storage, budget, report)
    return storage


def _explore_here(storage: StudyStorage, evaluate: Evaluate, budget: int, report: Progress) -> None:
    """Do trials, one after the other, in this process."""
    while _goes_on(storage, budget, report):
        trial = storage.ask(budget)
        if trial is None:
            _wait_for_others()
            continue
        try:
            storage.tell(trial, evaluate(storage.configuration(trial)))
        except BaseException as error:  # also an interrupt between evaluating and telling
            storage.give_up(trial, recorded(error))
            raise


def _explore_with(pool: Pool, storage: StudyStorage, budget: int, report: Progress) -> None:
    """Do trials in workers; the study's file stays with this process.

    The trial of a worker that dies, as one killed for want of memory, is redone.
    """
    running: dict[int, Trial] = {}
    deaths = 0
    try:
        while _goes_on(storage, budget, report):
            while pool.idle and (trial := storage.ask(budget)) is not None:
                running[trial.number] = trial
                pool.give(trial.number, storage.configuration(trial))
            if not running:
                _wait_for_others()
            for outcome in pool.take(timeout_s=1.0):
                trial = running.pop(outcome.key)
                if outcome.error is None:
                    storage.tell(trial, outcome.value)
                    deaths = 0
                    continue
                storage.give_up(trial, outcome.message)
                deaths += 1
                if not outcome.died or deaths > _MOST_DEATHS:
                    raise _complaint(outcome)
    except BaseException as error:
        for trial in running.values():
            storage.give_up(trial, recorded(error))
        raise


def _complaint(outcome: Outcome) -> Exception:
    """What a worker raised, or that workers die."""
    if outcome.is_bad_input:
        return InputError(outcome.message)
    if outcome.died:
        return RuntimeError(f"worker processes die ({outcome.error}); finished trials are kept")
    return RuntimeError(f"{outcome.error}, at {outcome.where}")


def _goes_on(storage: StudyStorage, budget: int, report: Progress) -> bool:
    """Whether trials are missing."""
    finished = len(storage.finished())
    report(finished)
    return finished < budget


def _wait_for_others() -> None:
    """Let other processes finish the last trials, or die."""
    time.sleep(0.05)
