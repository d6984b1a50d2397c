"""Pools of workers: what comes back, what a death costs, and the same on a Ray cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
from parallel_work import work

from ms_slam_env._runtime.parallel import Outcome, open_pool, run_each
from ms_slam_env._runtime.threads import available_cores, limited_threads, thread_environment
from ms_slam_env.errors import InputError, InputWarning


class Unreadable:
    """Ends the process that unpickles it."""

    def __reduce__(self) -> tuple:
        return os._exit, (3,)


def outcomes(specs: list[int], **options) -> dict[int, Outcome]:
    with open_pool(work, **options) as pool:
        found = {outcome.key: outcome for outcome in run_each(pool, {spec: spec for spec in specs})}
        assert pool.busy == 0
    return found


def test_workers_that_show_bars_leave_no_semaphore_behind() -> None:
    """Of which multiprocessing would complain at the end of every command."""
    code = "from test_parallel import outcomes; assert outcomes([2], workers=1)[2].error is None"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", f"if __name__ == '__main__':\n {code}"],
        cwd=Path(__file__).parent,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_warning_of_workers_is_one_of_this_process(capfd: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        with open_pool(work, workers=1, fresh=True) as pool:
            found = list(run_each(pool, {"a": 7, "b": 2, "c": 7}))
    assert [outcome.warnings for outcome in found] == [("7 is prime",), (), ("7 is prime",)]
    assert [(one.category, str(one.message)) for one in caught] == [(InputWarning, "7 is prime")]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("ray_address", [None, "local"])
def test_a_death_or_a_complaint_costs_only_its_own_spec(
    ray_address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if ray_address:
        pytest.importorskip("ray", reason="needs the extra ray")
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    environment = thread_environment(3)
    found = outcomes(
        [2, 13, -1, -2, 5], workers=2, ray_address=ray_address, environment=environment
    )
    assert [found[k].value["square"] for k in (2, 5)] == [4, 25]
    assert found[5].value["threads"] == "3"
    assert found[13].died
    assert found[13].error.startswith("the process died")
    assert (found[-1].error, found[-1].message) == (
        "InputError: no square of -1 second line",
        "no square of -1 second line",
    )
    assert found[-1].is_bad_input
    assert not found[-2].is_bad_input
    assert found[-2].where.startswith("parallel_work.py:")
    assert "ValueError" in found[-2].traceback
    assert all(outcome.value is None for outcome in found.values() if outcome.error)


def test_workers_are_kept_or_fresh() -> None:
    kept = {outcome.value["pid"] for outcome in outcomes([1, 2, 3], workers=1).values()}
    fresh = {
        outcome.value["pid"] for outcome in outcomes([1, 2, 3], workers=1, fresh=True).values()
    }
    assert (len(kept), len(fresh)) == (1, 3)
    assert os.getpid() not in kept | fresh


def test_waiting_ends_at_its_limit_and_without_work() -> None:
    with open_pool(work, workers=1) as pool:
        assert pool.take() == []
        pool.give("a", 3)
        assert (pool.idle, pool.busy) == (0, 1)
        assert pool.take(timeout_s=0.0) == []
        assert [outcome.key for outcome in pool.take()] == ["a"]


@pytest.mark.parametrize("seen", [True, False], ids=["death seen", "death after giving"])
def test_a_worker_that_died_while_it_rested_is_replaced(seen: bool) -> None:
    with open_pool(work, workers=1) as pool:
        pool.give("a", 2)
        (first,) = pool.take()
        if seen:
            os.kill(first.value["pid"], signal.SIGKILL)
            time.sleep(0.5)
            pool.give("b", 3)
        else:
            os.kill(first.value["pid"], signal.SIGSTOP)
            pool.give("b", 3)
            os.kill(first.value["pid"], signal.SIGKILL)
        (second,) = pool.take()
    assert (second.key, second.value["square"]) == ("b", 9)
    assert second.value["pid"] != first.value["pid"]


def test_a_worker_that_cannot_begin_costs_its_spec_and_is_not_tried_for_ever() -> None:
    with open_pool(work, workers=1) as pool:
        pool.give("a", Unreadable())
        (outcome,) = pool.take()
        assert (outcome.key, outcome.died) == ("a", True)
        pool.give("b", 3)
        (outcome,) = pool.take()
    assert outcome.value["square"] == 9


def test_there_must_be_a_worker() -> None:
    with pytest.raises(InputError, match="workers = 0 must be at least 1"):
        open_pool(work, workers=0)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system sets no affinity")
def test_threads_are_limited_for_a_while() -> None:
    before = available_cores()
    with limited_threads(1):
        assert available_cores() == 1
    with limited_threads(None):
        assert available_cores() == before
    assert available_cores() == before
