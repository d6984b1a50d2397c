"""Trials in this process, or in several on this machine."""

from __future__ import annotations

import multiprocessing
import os
import traceback
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from ms_slam_env.errors import InputError
from ms_slam_env.exploration.ledger import Ledger, wait_a_moment
from ms_slam_env.exploration.settings import Evaluate, ExplorationSettings
from ms_slam_env.exploration.space import SearchSpace

_MOST_DEATHS = 5  # of worker processes without a trial that finished in between


def explore_here(
    ledger: Ledger,
    evaluate: Evaluate,
    budget: int,
    report: Callable[[int], None],
    go_on: Callable[[], bool] = lambda: True,
) -> None:
    """Do trials, one after the other, until ``budget`` are finished or ``go_on`` says no."""
    while go_on():
        finished = len(ledger.finished())
        report(finished)
        if finished >= budget:
            return
        trial = ledger.ask(budget)
        if trial is None:  # others work on the last ones, and may die
            wait_a_moment()
            continue
        try:
            ledger.tell(trial, evaluate(ledger.configuration(trial)))
        except BaseException as error:  # also an interrupt between evaluating and telling
            ledger.give_up(trial, str(error) or type(error).__name__)
            raise


def explore_in_processes(
    ledger: Ledger, evaluate: Evaluate, budget: int, workers: int, report: Callable[[int], None]
) -> None:
    """Do trials in ``workers`` new processes, which share the study's file.

    A process that dies, as one killed for want of memory, is replaced and its trial redone.

    Raises:
        InputError: as an evaluation raised it.
        RuntimeError: processes die and nothing finishes, or an evaluation raised something else.
    """
    context = multiprocessing.get_context("spawn")
    complaints: Any = context.SimpleQueue()
    arguments = (ledger.folder, ledger.space, ledger.settings, evaluate, budget, os.getpid())

    def start() -> BaseProcess:
        process = context.Process(target=_work, args=(*arguments, complaints), daemon=True)
        process.start()
        return process

    alive = [start() for _ in range(workers)]
    deaths, before = 0, 0
    try:
        while alive:
            for process in list(alive):
                process.join(timeout=0.1)
                if process.exitcode is None:
                    continue
                alive.remove(process)
                if not complaints.empty():
                    kind, message = complaints.get()
                    raise (InputError if kind == "InputError" else RuntimeError)(message)
                finished = len(ledger.finished())
                if process.exitcode != 0 and finished < budget:
                    deaths = 1 if finished > before else deaths + 1
                    before = finished
                    if deaths > _MOST_DEATHS:
                        raise RuntimeError(
                            f"worker processes die (exit code {process.exitcode}); "
                            "finished trials are kept"
                        )
                    alive.append(start())
            report(len(ledger.finished()))
    finally:
        for process in alive:
            process.terminate()
        for process in alive:
            process.join()


def _work(
    folder: Path,
    space: SearchSpace,
    settings: ExplorationSettings,
    evaluate: Evaluate,
    budget: int,
    parent: int,
    complaints: Any,
) -> None:
    """Work on a study until it is finished or the process that started this one has gone."""
    try:
        ledger = Ledger(folder, space, settings)
        explore_here(ledger, evaluate, budget, lambda _: None, lambda: os.getppid() == parent)
    except KeyboardInterrupt:
        return
    except Exception as error:
        message = str(error)
        if not isinstance(error, InputError):
            message = f"{type(error).__name__}: {error}, at {_place(error)}"
        complaints.put((type(error).__name__, message))


def _place(error: Exception) -> str:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno}"
