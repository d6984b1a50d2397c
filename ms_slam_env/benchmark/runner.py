"""Runs many independent pieces of work in parallel processes and resumes after an interrupt."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ms_slam_env.errors import InputError
from ms_slam_env.parallel import available_cores, thread_environment
from ms_slam_env.report.provenance import git_commit
from ms_slam_env.report.records import RecordFile, Row, spec_key

RECORDS = "episodes.jsonl"
_NAMING = ("planner", "scene", "sequence", "backend", "seed")  # what a person calls the work by


def run_all(
    specs: Sequence[Any],
    run: Callable[[Any], dict[str, Any]],
    out: Path,
    workers: int | None = None,
    description: str = "episodes",
) -> list[Row]:
    """Run every spec once, in parallel, and return one row for each, in the order of ``specs``.

    Rows that an earlier call left in ``out`` are taken from there, except failed ones, which are
    tried again. A row has ``key``, ``spec``, ``result`` (what ``run`` returned, None if it
    raised or its process died), ``error`` (None or the message), ``elapsed_s`` and ``commit``
    (of the code that made it).

    Args:
        specs: dataclasses; the key of the work is made of all their fields.
        run: a function that a new process can import.
        out: folder of the results.
        workers: processes, each of one thread; None for one a core.
        description: shown at the progress bar.

    Raises:
        InputError: fewer than one worker, a folder that cannot be made, or a file of results
            that cannot be read.
    """
    workers = available_cores() if workers is None else workers
    if workers < 1:
        raise InputError(f"workers = {workers} must be at least 1")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"no results can be written to {out}: {error.strerror}") from None
    records = RecordFile(out / RECORDS)
    keys = [spec_key(spec) for spec in specs]
    rows = {key: row for key, row in records.load().items() if row["error"] is None}
    todo = {key: spec for key, spec in zip(keys, specs, strict=True) if key not in rows}
    done = len(set(keys)) - len(todo)
    if done:
        print(f"{description}: {done} of {len(set(keys))} already in {out}", file=sys.stderr)
    if todo:
        with tqdm(total=len(set(keys)), initial=done, desc=description, unit="") as bar:
            commit = git_commit()
            name_of = names(
                {key: dataclasses.asdict(spec) for key, spec in zip(keys, specs, strict=True)}
            )

            def finish(row: Row) -> None:
                row["commit"] = commit
                records.append(row)
                rows[row["key"]] = row
                bar.update()
                if row["error"] is not None:
                    name = name_of[row["key"]]
                    bar.write(f"failed: {name}: {row['error']}", file=sys.stderr)

            _run_missing(todo, run, workers, finish)
    return [rows[key] for key in keys]


def failures(rows: Sequence[Row]) -> list[str]:
    """The errors among ``rows``, one line each."""
    failed = [row for row in rows if row["error"] is not None]
    if not failed:
        return []
    name_of = names({row["key"]: row["spec"] for row in rows})
    return [f"{name_of[row['key']]}: {row['error']}" for row in failed]


def names(specs: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Words for pieces of work, given and returned by key.

    As in ``planner greedy, scene table, seed 2000``, then what else differs among them.
    """
    every = list(dict.fromkeys(name for spec in specs.values() for name in spec))
    shown = [
        name
        for name in every
        if name in _NAMING or len({str(spec.get(name)) for spec in specs.values()}) > 1
    ]
    shown.sort(key=lambda name: (name not in _NAMING, every.index(name)))
    return {
        key: ", ".join(f"{name} {spec[name]}" for name in shown if name in spec) or key
        for key, spec in specs.items()
    }


def check_any_finished(rows: Sequence[Row]) -> None:
    """Refuse to go on where all work failed, so that no good report is overwritten by an empty one.

    Raises:
        RuntimeError: with the first error.
    """
    errors = failures(rows)
    if rows and len(errors) == len(rows):
        raise RuntimeError(f"all {len(rows)} failed, the first: {errors[0]}; no report is written")


def _run_missing(
    todo: dict[str, Any],
    run: Callable[[Any], dict[str, Any]],
    workers: int,
    finish: Callable[[Row], None],
) -> None:
    for name, one in thread_environment(1).items():  # inherited, and read when libraries load
        os.environ.setdefault(name, one)
    waiting = list(todo.items())[::-1]
    busy = {}
    try:
        for _ in range(min(workers, len(waiting))):
            worker = _Worker(run)
            busy[worker.pipe] = worker
            worker.give(*waiting.pop())
        while busy:
            answered = wait(list(busy))
            for pipe in [pipe for pipe in busy if pipe in answered]:
                worker = busy.pop(pipe)
                finish(worker.take())
                if not worker.alive:
                    worker = _Worker(run)
                if waiting:
                    busy[worker.pipe] = worker
                    worker.give(*waiting.pop())
                else:
                    worker.stop()
    finally:
        # After an interrupt, what runs at this moment is lost and done again by the next call.
        for worker in busy.values():
            worker.stop()


class _Worker:
    """A process that runs one spec after another; its death costs only the spec in its hands."""

    def __init__(self, run: Callable[[Any], dict[str, Any]]) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, run), daemon=True)
        self._process.start()
        theirs.close()  # so that reading ends when the process does
        self.alive = True

    def give(self, key: str, spec: Any) -> None:
        """Let the process run a spec."""
        self._key, self._spec, self._start = key, spec, time.perf_counter()
        self.pipe.send((key, spec))

    def take(self) -> Row:
        """Its row; a row with an error if the process died on it."""
        try:
            return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.alive = False
            self._process.join()
            row = _empty_row(self._key, self._spec)
            row["error"] = f"the process died, exit code {self._process.exitcode}"
            row["elapsed_s"] = round(time.perf_counter() - self._start, 3)
            return row

    def stop(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()
        self.pipe.close()


def _serve(pipe: Connection, run: Callable[[Any], dict[str, Any]]) -> None:
    _prepare_worker()
    while True:
        try:
            key, spec = pipe.recv()
        except EOFError:
            return
        pipe.send(_run_one(run, key, spec))


def _prepare_worker() -> None:
    """Leave Ctrl-C to the parent, and end when the parent is gone, even if it was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _run_one(run: Callable[[Any], dict[str, Any]], key: str, spec: Any) -> Row:
    start = time.perf_counter()
    row = _empty_row(key, spec)
    try:
        row["result"] = run(spec)
    except Exception as error:
        row["error"] = f"{type(error).__name__}: {error}".splitlines()[0]
        row["traceback"] = traceback.format_exc()
    row["elapsed_s"] = round(time.perf_counter() - start, 3)
    return row


def _empty_row(key: str, spec: Any) -> Row:
    return {"key": key, "spec": dataclasses.asdict(spec), "result": None, "error": None}
