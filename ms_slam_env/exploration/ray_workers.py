"""Trials on a Ray cluster: this process keeps the study, others evaluate."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ms_slam_env.errors import InputError
from ms_slam_env.exploration.ledger import Ledger, wait_a_moment
from ms_slam_env.exploration.settings import Evaluate

if TYPE_CHECKING:
    from optuna import Trial

LOCAL = "local"
_MOST_DEATHS = 5  # of evaluators without a trial that finished in between


def explore_on_ray(
    ledger: Ledger,
    evaluate: Evaluate,
    budget: int,
    address: str,
    workers: int,
    report: Callable[[int], None],
) -> None:
    """Do trials on a cluster, ``workers`` at a time.

    The study's file stays with this process; only configurations and results travel. An evaluator
    whose machine or process dies is replaced and its trial redone.

    Raises:
        InputError: Ray is not installed, no cluster at ``address``, or as an evaluation raised it.
        RuntimeError: evaluators die and nothing finishes.
    """
    ray = _connect(address, workers)
    try:
        _work(ray, ledger, evaluate, budget, workers, report)
    finally:
        ray.shutdown()


def _connect(address: str, workers: int) -> Any:
    try:
        import ray
    except ImportError:
        raise InputError("--ray needs Ray: pip install 'ms-slam-env[ray]'") from None
    own: dict[str, Any] = {}
    if address == LOCAL:
        own = {"include_dashboard": False, "num_cpus": workers}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, ValueError, RuntimeError) as error:
        line = " ".join(str(error).split())
        raise InputError(f"--ray {address}: no Ray cluster there: {line[:200]}") from None
    return ray


def _work(
    ray: Any,
    ledger: Ledger,
    evaluate: Evaluate,
    budget: int,
    workers: int,
    report: Callable[[int], None],
) -> None:
    evaluator = ray.remote(num_cpus=1)(_Evaluator)
    shared = ray.put(evaluate)
    idle = [evaluator.remote(shared) for _ in range(workers)]
    running: dict[Any, tuple[Any, Trial]] = {}
    deaths = 0
    try:
        while True:
            finished = len(ledger.finished())
            report(finished)
            if finished >= budget:
                return
            while idle and (trial := ledger.ask(budget)) is not None:
                actor = idle.pop()
                future = actor.measure.remote(ledger.configuration(trial))
                running[future] = (actor, trial)
            if not running:
                wait_a_moment()
                continue
            ready, _ = ray.wait(list(running), timeout=1.0)
            for future in ready:
                actor, trial = running.pop(future)
                try:
                    measured = ray.get(future)
                except ray.exceptions.RayActorError as error:
                    ledger.give_up(trial, "its process died")
                    deaths += 1
                    if deaths > _MOST_DEATHS:
                        raise RuntimeError(f"Ray's processes die: {error}") from error
                    actor = evaluator.remote(shared)
                except ray.exceptions.RayTaskError as error:
                    ledger.give_up(trial, str(error.cause))
                    raise error.cause from None
                else:
                    ledger.tell(trial, measured)
                    deaths = 0
                idle.append(actor)
    except BaseException as error:
        for _, trial in running.values():
            ledger.give_up(trial, str(error) or type(error).__name__)
        raise


class _Evaluator:
    """Keeps what an evaluation caches, such as its sequences, from trial to trial."""

    def __init__(self, evaluate: Evaluate) -> None:
        self._evaluate = evaluate

    def measure(self, configuration: Any) -> Any:
        """Measure one configuration."""
        return self._evaluate(configuration)
