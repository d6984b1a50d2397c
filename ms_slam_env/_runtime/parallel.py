"""Run work in several processes, here or on a Ray cluster.

A pool runs one spec after another in each of its workers, which keep their caches. If a worker
dies, only its current spec is lost::

    with open_pool(run, workers=4, ray_address=args.ray) as pool:
        for outcome in run_each(pool, {key: spec for ...}):    # as they finish
            outcome.key, outcome.value, outcome.error, outcome.elapsed_s

If the next spec depends on earlier outcomes, give and take by hand::

    while pool.idle and (spec := next_spec()):
        pool.give(key, spec)
    for outcome in pool.take(timeout_s=1.0): ...

``run`` must be importable by (or picklable for) a new process, and so must specs and values.
Ctrl-C ends the caller, which ends the workers; they also end when the caller is killed.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm

from ms_slam_env._runtime.threads import available_cores
from ms_slam_env.errors import InputError, InputWarning

LOCAL_CLUSTER = "local"
"""Address that starts a Ray cluster on this machine for the lifetime of the pool."""

Run = Callable[[Any], Any]


@dataclass(frozen=True)
class Outcome:
    """Outcome of running a spec.

    Attributes:
        key: key that the spec was given with.
        value: return value of ``run``; None if it raised or its worker died.
        error: first line of the error, with the type of the exception; None if there was none.
        message: message of the exception.
        where: where the exception was raised, as ``file:line``.
        traceback: traceback of the exception.
        is_bad_input: whether it was an ``InputError``.
        died: whether the worker died.
        elapsed_s: time by the clock, seconds.
        warnings: what it warned of about input; the pool repeats it in this process.
    """

    key: Any
    value: Any = None
    error: str | None = None
    message: str = ""
    where: str = ""
    traceback: str = ""
    is_bad_input: bool = False
    died: bool = False
    elapsed_s: float = 0.0
    warnings: tuple[str, ...] = ()


def attempt(run: Run, key: Any, spec: Any) -> Outcome:
    """Run ``spec`` in this process; the outcome holds any exception."""
    start = time.perf_counter()
    try:
        outcome = Outcome(key, run(spec))
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        outcome = Outcome(
            key,
            error=f"{type(error).__name__}: {error}".splitlines()[0],
            message=str(error),
            where=f"{Path(frame.filename).name}:{frame.lineno}",
            traceback=traceback.format_exc(),
            is_bad_input=isinstance(error, InputError),
        )
    return replace(outcome, elapsed_s=round(time.perf_counter() - start, 3))


class _Worker(Protocol):
    """A process, here or in a cluster, that runs one spec after another."""

    def send(self, spec: Any) -> Any:
        """Start a spec; return an object (pipe or future) that becomes ready when it is done."""

    def receive(self) -> Outcome:
        """Outcome of the spec, without key.

        Raises:
            _DiedError: the worker died while running it.
            _DiedAtRestError: the worker died before starting it.
        """

    def stop(self) -> None:
        """End the worker, whatever it is doing."""


class _DiedError(Exception):
    """A worker died; the message says how."""


class _DiedAtRestError(Exception):
    """A worker died between two specs, so the second was not started."""


class Pool:
    """Workers that each run one spec after another, started when there is work.

    Use it as a context manager: on exit the workers are stopped, whatever they are doing.
    """

    def __init__(
        self,
        start: Callable[[], _Worker],
        wait_for: Callable[[list[Any], float | None], Sequence[Any]],
        workers: int,
        fresh: bool,
        leave: Callable[[], None] = lambda: None,
    ) -> None:
        self._start, self._wait_for, self._leave = start, wait_for, leave
        self._workers, self._fresh = workers, fresh
        self._resting: list[_Worker] = []
        self._working: dict[Any, tuple[_Worker, Any, Any, float]] = {}  # key, spec and its start

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    @property
    def idle(self) -> int:
        """Number of workers that wait for a spec."""
        return self._workers - len(self._working)

    @property
    def busy(self) -> int:
        """Number of workers that are running a spec."""
        return len(self._working)

    def give(self, key: Any, spec: Any) -> None:
        """Let an idle worker run ``spec``; there must be one."""
        worker = self._resting.pop() if self._resting else self._start()
        self._working[worker.send(spec)] = (worker, key, spec, time.perf_counter())

    def take(self, timeout_s: float | None = None) -> list[Outcome]:
        """Wait up to ``timeout_s`` and return the outcomes so far; none if no worker is busy.

        A dead worker is replaced, and a spec that it had not started goes to another worker; on a
        cluster it does not, since one cannot tell whether it had started.
        """
        outcomes: list[Outcome] = []
        while self._working and not outcomes:
            for done in self._wait_for(list(self._working), timeout_s):
                outcome = self._outcome(*self._working.pop(done))
                outcomes += [outcome] if outcome else []
            if timeout_s is not None:
                break
        return outcomes

    def _outcome(self, worker: _Worker, key: Any, spec: Any, start: float) -> Outcome | None:
        """Outcome of the spec; None if it was passed to another worker."""
        try:
            outcome = replace(worker.receive(), key=key)
        except _DiedAtRestError:
            worker.stop()
            self.give(key, spec)
            return None
        except _DiedError as error:
            message = f"the process died{error}"
            elapsed_s = round(time.perf_counter() - start, 3)
            outcome = Outcome(key, None, message, message, died=True, elapsed_s=elapsed_s)
        for text in outcome.warnings:
            warnings.warn(text, InputWarning, stacklevel=2)
        if self._fresh or outcome.died:
            worker.stop()
        else:
            self._resting.append(worker)
        return outcome

    def stop(self) -> None:
        """Stop the workers; running specs are lost."""
        for worker in (*self._resting, *(each[0] for each in self._working.values())):
            worker.stop()
        self._resting, self._working = [], {}
        self._leave()


def run_each(pool: Pool, specs: Mapping[Any, Any]) -> Iterator[Outcome]:
    """Outcomes of all ``specs`` in the order they finish; specs start in the given order."""
    waiting = iter(specs.items())
    left = len(specs)
    while left or pool.busy:
        while pool.idle and left:
            pool.give(*next(waiting))
            left -= 1
        yield from pool.take()


def open_pool(
    run: Run,
    workers: int | None = None,
    ray_address: str | None = None,
    *,
    environment: Mapping[str, str] | None = None,
    fresh: bool = False,
) -> Pool:
    """Workers that call ``run``.

    Args:
        run: function called with one spec after another.
        workers: number of workers; None for one per core of this machine.
        ray_address: address of a Ray cluster, or `LOCAL_CLUSTER` to start one; None for processes
            of this machine.
        environment: environment variables of the workers, in addition to this process's.
        fresh: whether each spec runs in a new process, as needed to measure peak memory.

    Raises:
        InputError: fewer than one worker, Ray is not installed, or no cluster at the address.
    """
    workers = available_cores() if workers is None else workers
    if workers < 1:
        raise InputError(f"workers = {workers} must be at least 1")
    variables = dict(environment or {})
    if ray_address is None:
        return Pool(partial(_Process, run, variables), wait, workers, fresh)
    ray = _connect(ray_address, workers)
    actor = ray.remote(num_cpus=1, runtime_env={"env_vars": variables})(_Attempts)
    there = ray.put(run)
    return Pool(
        lambda: _RayWorker(ray, actor.remote(there)),
        lambda working, timeout_s: ray.wait(working, timeout=timeout_s)[0],
        workers,
        fresh,
        ray.shutdown,
    )


# -- Processes of this machine -----------------------------------------------------------------


class _Process:
    """A process of this machine."""

    def __init__(self, run: Run, environment: Mapping[str, str]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._begun, begins = context.Pipe(duplex=False)  # a message for each spec it starts
        self._has_rested = False
        arguments = (theirs, begins, run)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        with _environment(environment):  # inherited, and read by libraries on loading
            self._process.start()
        theirs.close()  # so that reading ends when the process does
        begins.close()

    def send(self, spec: Any) -> Connection:
        with contextlib.suppress(ConnectionError):  # it died: `receive` says so
            self._pipe.send(spec)
        return self._pipe

    def receive(self) -> Outcome:
        try:
            outcome: Outcome = self._pipe.recv()
            self._begun.recv_bytes()
        except (EOFError, ConnectionError):
            self._process.join()
            if self._has_rested and not self._has_begun():  # else it cannot begin at all
                raise _DiedAtRestError from None
            raise _DiedError(f", exit code {self._process.exitcode}") from None
        self._has_rested = True
        return outcome

    def _has_begun(self) -> bool:
        """Whether the dead process had started the last spec it was sent."""
        try:
            self._begun.recv_bytes()
        except (EOFError, ConnectionError):
            return False
        return True

    def stop(self) -> None:
        self._process.terminate()
        self._process.join()
        self._pipe.close()
        self._begun.close()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set these environment variables within the context."""
    before = {name: os.environ[name] for name in variables if name in os.environ}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            del os.environ[name]
        os.environ.update(before)


def _serve(pipe: Connection, begun: Connection, run: Run) -> None:
    """Run specs that arrive through ``pipe``; leave Ctrl-C to the parent, and end with it."""
    tqdm.set_lock(threading.RLock())  # its default is a semaphore, which a killed process leaks
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()  # the parent may be killed
    warned = _collect_input_warnings()
    while True:
        try:
            spec = pipe.recv()
        except EOFError:
            return
        begun.send_bytes(b"1")
        pipe.send(replace(attempt(run, None, spec), warnings=tuple(warned)))
        warned.clear()


def _collect_input_warnings() -> list[str]:
    """From now on add warnings about input to a list, so that several workers say them once."""
    warned: list[str] = []
    show = warnings.showwarning

    def collect(message: Warning | str, category: type[Warning], *args: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            warned.append(str(message))
        else:
            show(message, category, *args, **more)

    warnings.showwarning = collect
    return warned


# -- A Ray cluster -----------------------------------------------------------------------------


class _RayWorker:
    """An actor of a Ray cluster, with a core for itself."""

    def __init__(self, ray: Any, actor: Any) -> None:
        self._ray, self._actor = ray, actor

    def send(self, spec: Any) -> Any:
        self._future = self._actor.attempt.remote(spec)
        return self._future

    def receive(self) -> Outcome:
        try:
            return self._ray.get(self._future)
        except self._ray.exceptions.RayActorError as error:
            raise _DiedError(f": {' '.join(str(error).split())}") from None

    def stop(self) -> None:
        self._ray.kill(self._actor)


class _Attempts:
    """Runs specs on a machine of the cluster."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def attempt(self, spec: Any) -> Outcome:
        return attempt(self._run, None, spec)


def _connect(address: str, workers: int) -> Any:
    """Ray's module, connected to the cluster."""
    try:
        import ray
    except ImportError:
        raise InputError("--ray needs Ray: pip install 'ms-slam-env[ray]'") from None
    own: dict[str, Any] = {}
    if address == LOCAL_CLUSTER:
        own = {"include_dashboard": False, "num_cpus": workers}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, ValueError, RuntimeError) as error:
        line = " ".join(str(error).split())
        raise InputError(f"--ray {address}: no Ray cluster there: {line[:200]}") from None
    return ray
