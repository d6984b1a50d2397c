"""Work for several processes, here or on a Ray cluster, and how many threads a process takes.

A pool runs one spec after another in each of its workers, which keep what they have cached; the
death of a worker costs only the spec in its hands::

    with open_pool(run, workers=4, ray_address=args.ray) as pool:
        for outcome in run_each(pool, {key: spec for ...}):    # as they finish
            outcome.key, outcome.value, outcome.error, outcome.elapsed_s

Who decides what comes next by what has come back gives and takes by hand::

    while pool.idle and (spec := next_spec()):
        pool.give(key, spec)
    for outcome in pool.take(timeout_s=1.0): ...

``run`` must be importable by (or picklable for) a new process, and so must specs and values.
Ctrl-C ends the caller, which ends the workers; they end too when the caller is killed.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from ms_slam_env.errors import InputError

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)
"""By which libraries learn, when they are loaded, how many threads they may start."""

LOCAL_CLUSTER = "local"
"""Address of a Ray cluster on this machine that lives as long as the pool."""

Run = Callable[[Any], Any]


# -- Threads -----------------------------------------------------------------------------------


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that give libraries loaded from now on so many threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))


def one_thread_unless_set() -> dict[str, str]:
    """Those of `thread_environment` for one thread that the user has not set otherwise."""
    return {name: one for name, one in thread_environment(1).items() if name not in os.environ}


def limit_threads(threads: int) -> None:
    """Keep this process on so many cores, whatever its libraries think.

    Libraries that are loaded later read the environment variables, OpenCV is told, and pools that
    heed neither (TBB) obey the affinity.
    """
    import cv2

    os.environ.update(thread_environment(threads))
    cv2.setNumThreads(threads)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


@contextmanager
def limited_threads(threads: int | None) -> Iterator[None]:
    """Keep the enclosed work on so many cores; None leaves everything as it is."""
    if threads is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:threads])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


# -- Work --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What came of a spec.

    Attributes:
        key: that it was given with.
        value: what ``run`` returned; None if it raised or its worker died.
        error: the first line of what went wrong, with the kind of the exception; None if nothing.
        message: what the exception itself said.
        where: the exception was raised, as ``file:line``.
        traceback: of the exception.
        is_bad_input: whether it was an ``InputError``.
        died: whether the worker died on it.
        elapsed_s: by the clock.
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


def attempt(run: Run, key: Any, spec: Any) -> Outcome:
    """Run ``spec`` here; what it raises is in the outcome."""
    start = time.perf_counter()
    try:
        outcome = Outcome(key, run(spec))
    except Exception as error:
        outcome = Outcome(
            key,
            error=f"{type(error).__name__}: {error}".splitlines()[0],
            message=str(error),
            where=_place(error),
            traceback=traceback.format_exc(),
            is_bad_input=isinstance(error, InputError),
        )
    return replace(outcome, elapsed_s=round(time.perf_counter() - start, 3))


def _place(error: Exception) -> str:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno}"


class Pool(ABC):
    """Workers that each run one spec after another.

    Use it as a context: at its end the workers are ended, whatever they are doing.
    """

    def __enter__(self) -> Pool:
        """Return itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """End the workers."""
        self.stop()

    @property
    @abstractmethod
    def idle(self) -> int:
        """Workers that wait for a spec."""

    @property
    @abstractmethod
    def busy(self) -> int:
        """Workers that have a spec in their hands."""

    @abstractmethod
    def give(self, key: Any, spec: Any) -> None:
        """Let an idle worker run ``spec``; there must be one."""

    @abstractmethod
    def take(self, timeout_s: float | None = None) -> list[Outcome]:
        """Wait for outcomes, at most so long; those that are there, none if no worker is busy.

        A worker that died is replaced.
        """

    @abstractmethod
    def stop(self) -> None:
        """End the workers; what runs at this moment is lost."""


def run_each(pool: Pool, specs: Mapping[Any, Any]) -> Iterator[Outcome]:
    """Outcomes of all ``specs``, in the order in which they finish; specs are begun in theirs."""
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
        run: called with one spec after another.
        workers: how many; None for one a core of this machine.
        ray_address: of a Ray cluster, `LOCAL_CLUSTER` for one of its own; None for processes of
            this machine.
        environment: variables of the workers beside those of this process.
        fresh: whether each spec has a new process, as measuring peak memory needs it.

    Raises:
        InputError: fewer than one worker, Ray is not installed, or no cluster at the address.
    """
    workers = available_cores() if workers is None else workers
    if workers < 1:
        raise InputError(f"workers = {workers} must be at least 1")
    if ray_address is not None:
        return RayPool(run, workers, ray_address, dict(environment or {}), fresh)
    return LocalPool(run, workers, dict(environment or {}), fresh)


# -- Processes of this machine -----------------------------------------------------------------


class LocalPool(Pool):
    """Processes of this machine, started when there is work for them."""

    def __init__(self, run: Run, workers: int, environment: dict[str, str], fresh: bool) -> None:
        self._run, self._workers, self._fresh = run, workers, fresh
        self._environment = environment
        self._idle: list[_Process] = []
        self._busy: dict[Any, _Process] = {}  # by pipe

    @property
    def idle(self) -> int:
        """Workers that wait for a spec."""
        return self._workers - len(self._busy)

    @property
    def busy(self) -> int:
        """Workers that have a spec in their hands."""
        return len(self._busy)

    def give(self, key: Any, spec: Any) -> None:
        """Let a worker run ``spec``."""
        process = self._idle.pop() if self._idle else _Process(self._run, self._environment)
        self._busy[process.pipe] = process
        process.give(key, spec)

    def take(self, timeout_s: float | None = None) -> list[Outcome]:
        """Wait for outcomes, at most so long."""
        outcomes = []
        for pipe in wait(list(self._busy), timeout_s) if self._busy else ():
            process = self._busy.pop(pipe)
            outcomes.append(process.take())
            if self._fresh or outcomes[-1].died:
                process.stop()
            else:
                self._idle.append(process)
        return outcomes

    def stop(self) -> None:
        """End the workers."""
        processes = [*self._idle, *self._busy.values()]
        self._idle, self._busy = [], {}
        for process in processes:
            process.stop()


class _Process:
    """A process that runs one spec after another."""

    def __init__(self, run: Run, environment: Mapping[str, str]) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, run), daemon=True)
        with _environment(environment):  # inherited, and read when libraries are loaded
            self._process.start()
        theirs.close()  # so that reading ends when the process does

    def give(self, key: Any, spec: Any) -> None:
        """Let the process run a spec."""
        self._key, self._start = key, time.perf_counter()
        self.pipe.send((key, spec))

    def take(self) -> Outcome:
        """Its outcome, also if the process died on it."""
        try:
            return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self._process.join()
            error = f"the process died, exit code {self._process.exitcode}"
            elapsed_s = round(time.perf_counter() - self._start, 3)
            return Outcome(self._key, error=error, message=error, died=True, elapsed_s=elapsed_s)

    def stop(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()
        self.pipe.close()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Have these environment variables meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(pipe: Connection, run: Run) -> None:
    """Run what comes through ``pipe`` until it ends."""
    _leave_with_parent()
    while True:
        try:
            key, spec = pipe.recv()
        except EOFError:
            return
        pipe.send(attempt(run, key, spec))


def _leave_with_parent() -> None:
    """Leave Ctrl-C to the parent, and end when the parent is gone, even if it was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# -- A Ray cluster -----------------------------------------------------------------------------


class RayPool(Pool):
    """Actors of a Ray cluster, a core for each; ``run`` and specs travel there, outcomes back."""

    def __init__(
        self, run: Run, workers: int, address: str, environment: dict[str, str], fresh: bool
    ) -> None:
        self._ray = _connect(address, workers)
        self._actor = self._ray.remote(num_cpus=1, runtime_env={"env_vars": environment})(_Actor)
        self._run = self._ray.put(run)
        self._fresh = fresh
        self._idle = [self._actor.remote(self._run) for _ in range(workers)]
        self._busy: dict[Any, tuple[Any, Any, float]] = {}  # by future: actor, key, start

    @property
    def idle(self) -> int:
        """Workers that wait for a spec."""
        return len(self._idle)

    @property
    def busy(self) -> int:
        """Workers that have a spec in their hands."""
        return len(self._busy)

    def give(self, key: Any, spec: Any) -> None:
        """Let a worker run ``spec``."""
        actor = self._idle.pop()
        self._busy[actor.attempt.remote(spec)] = (actor, key, time.perf_counter())

    def take(self, timeout_s: float | None = None) -> list[Outcome]:
        """Wait for outcomes, at most so long."""
        ready, _ = self._ray.wait(list(self._busy), timeout=timeout_s) if self._busy else ((), ())
        return [self._take(future) for future in ready]

    def _take(self, future: Any) -> Outcome:
        actor, key, start = self._busy.pop(future)
        try:
            outcome = replace(self._ray.get(future), key=key)
        except self._ray.exceptions.RayActorError as error:
            message = f"the process died: {' '.join(str(error).split())}"
            elapsed_s = round(time.perf_counter() - start, 3)
            outcome = Outcome(key, error=message, message=message, died=True, elapsed_s=elapsed_s)
        if self._fresh and not outcome.died:
            self._ray.kill(actor)
        is_alive = not (self._fresh or outcome.died)
        self._idle.append(actor if is_alive else self._actor.remote(self._run))
        return outcome

    def stop(self) -> None:
        """End the workers and leave the cluster."""
        self._ray.shutdown()


class _Actor:
    """Runs specs on a machine of the cluster."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def attempt(self, spec: Any) -> Outcome:
        """Run a spec; the caller knows its key."""
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
