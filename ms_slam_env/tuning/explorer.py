"""Explore until enough trials have finished: in this process, in workers, or on Ray."""

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

_MOST_DEATHS = 5  # of workers without a finished trial in between


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
    """Start or resume the study in ``folder``, until ``budget`` trials have finished.

    The call may be killed at any time and repeated: finished trials are kept, running ones are
    marked as failed and repeated. Several processes may call it and share the work. (``ms-slam
    explore`` locks its folder, and starts processes with ``--workers``.)

    Args:
        folder: folder of the study.
        space: the parameters.
        settings: settings of the exploration.
        evaluate: measures a configuration.
        budget: number of finished trials, including those of earlier calls.
        workers: number of processes; with Ray, of parallel evaluations.
        ray_address: address of a Ray cluster; ``local`` starts one on this machine for the
            duration of the call; None for no Ray.
        progress: called from time to time with the number of finished trials.

    Raises:
        InputError: bad input, or a folder with another study.
        RuntimeError: worker processes die repeatedly, or an evaluation raised another exception.
    """
    if isinstance(budget, bool) or budget < 1 or workers < 1:
        name, value = ("trials", budget) if budget < 1 else ("workers", workers)
        raise InputError(f"{name} = {value} must be at least 1")
    storage = StudyStorage(folder, space, settings)
    report = progress or (lambda finished: None)
    with kept(f"finished trials are kept in {folder}; the same command continues"):
        if workers == 1 and ray_address is None:
            _explore_here(storage, evaluate, budget, report)
        else:
            with open_pool(evaluate, workers, ray_address) as pool:
                _explore_with(pool, storage, budget, report)
    return storage


def _explore_here(storage: StudyStorage, evaluate: Evaluate, budget: int, report: Progress) -> None:
    """Run trials one after the other in this process."""
    while _goes_on(storage, budget, report):
        trial = storage.ask(budget)
        if trial is None:
            _wait_for_others()
            continue
        try:
            storage.tell(trial, evaluate(storage.configuration(trial)))
        except BaseException as error:  # including an interrupt before the result is stored
            storage.give_up(trial, recorded(error))
            raise


def _explore_with(pool: Pool, storage: StudyStorage, budget: int, report: Progress) -> None:
    """Run trials in workers; only this process accesses the study's file.

    If a worker dies, for example for lack of memory, its trial is repeated.
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
    """The exception that a worker raised, or one that says that workers die."""
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
    """Wait until other processes have finished the last trials or died."""
    time.sleep(0.05)
