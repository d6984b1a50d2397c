"""Run the missing rows of an experiment in parallel, then write its results."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ms_slam_env._runtime.interrupts import kept
from ms_slam_env._runtime.output_files import check_out_folder
from ms_slam_env._runtime.parallel import Outcome as Done
from ms_slam_env._runtime.parallel import open_pool, run_each
from ms_slam_env._runtime.progress import Bar
from ms_slam_env._runtime.result_folders import alone_in
from ms_slam_env._runtime.threads import one_thread_unless_set
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.benchmark.planner_tables import with_privilege
from ms_slam_env.errors import InputError, one_line
from ms_slam_env.evaluation.run_sequence import lost_throughout
from ms_slam_env.metrics.registry import RESULTS_VERSION, versions_since
from ms_slam_env.report.provenance import git_commit
from ms_slam_env.report.records import RecordFile, Row, from_plain, spec_key, to_plain
from ms_slam_env.report.results import RESULTS, Results, write_result_folder
from ms_slam_env.report.sources import joined, sources_of
from ms_slam_env.report.tables import finished

RECORDS = "rows.jsonl"
_NAMING = ("planner", "scene", "sequence", "backend", "seed")  # fields that always name a row


def run_all(
    specs: Sequence[Any],
    run: Callable[[Any], dict[str, Any]],
    out: Path,
    workers: int | None = None,
    description: str = "episodes",
    *,
    ray: str | None = None,
    fresh: bool = False,
    environment: Mapping[str, str] | None = None,
    kind: str = "",
    parts: Sequence[str] = (),
) -> list[Row]:
    """Run every spec once, in parallel; return one row for each, in the order of ``specs``.

    A spec given twice has one row, so that it does not count twice.

    Rows that an earlier call left in ``out`` are reused, except those that failed, those made by an
    algorithm that has changed since, and those that name a file whose content has changed. A row
    has ``key``, ``spec``, ``result`` (the return value of ``run``, None if it raised or its process
    died), ``error`` (None or the message), ``elapsed_s``, ``commit`` (of the code that made it),
    ``results_version``, ``sources`` (digests of the code that made it, by part) and ``files``
    (hashes by name).

    Args:
        specs: dataclasses; all their fields together make the key of a row.
        run: a function that a new process can import.
        out: folder of the results.
        workers: number of processes, of one thread each; None for one per core.
        description: label of the progress bar.
        ray: address of a Ray cluster whose workers run the specs; None: processes of this machine.
        fresh: whether each spec runs in a new process.
        environment: environment variables of the processes; None: one thread each, unless already
            set.
        kind: kind of the result, used to look up what has changed since a row was made.
        parts: parts of the code that the rows use; none: all.

    Raises:
        InputError: fewer than one worker, no Ray or no cluster at the address, a folder that cannot
            be made, or a file of results that cannot be read.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers = {workers} must be at least 1")
    check_out_folder(out)
    records = RecordFile(out / RECORDS)
    keys = [spec_key(spec) for spec in specs]
    files = {key: file_hashes(spec) for key, spec in zip(keys, specs, strict=True)}
    rows = {
        key: row
        for key, row in records.load().items()
        if row.get("error", "") is None
        and not versions_since(row.get("results_version", RESULTS_VERSION), kind)
    }
    changed = {key for key, now in files.items() if rows.get(key, {}).get("files", now) != now}
    rows = {key: row for key, row in rows.items() if key not in changed}
    if changed:
        again = f"{len(changed)} of {len(files)} are made again: a file that they name has changed"
        print(f"{description}: {again}", file=sys.stderr)
    todo = {key: spec for key, spec in zip(keys, specs, strict=True) if key not in rows}
    done = len(set(keys)) - len(todo)
    commit = git_commit()
    if done:
        older = sum(rows[key].get("commit") != commit for key in set(keys) & rows.keys())
        by = f", {older} of them made by other code" if older else ""
        print(f"{description}: {done} of {len(set(keys))} already in {out}{by}", file=sys.stderr)
    if todo:
        # Before the rows run, since files may be edited meanwhile.
        sources = sources_of(kind, str([dataclasses.asdict(spec) for spec in specs]), parts)
        with Bar(total=len(set(keys)), initial=done, desc=description, unit="") as bar:
            name_of = names(
                {key: dataclasses.asdict(spec) for key, spec in zip(keys, specs, strict=True)}
            )

            def finish(row: Row) -> None:
                row |= {"commit": commit, "results_version": RESULTS_VERSION, "sources": sources}
                row |= {"files": files[row["key"]]} if files[row["key"]] else {}
                records.append(row)
                rows[row["key"]] = row
                bar.update()
                if row["error"] is not None:
                    name = name_of[row["key"]]
                    bar.write(one_line(f"failed: {name}: {row['error']}"), file=sys.stderr)

            variables = one_thread_unless_set() if environment is None else environment
            pool = open_pool(run, workers, ray, environment=variables, fresh=fresh)
            with (
                kept(f"finished {description} are kept in {out}; the same command continues"),
                pool,
            ):
                for outcome in run_each(pool, todo):
                    finish(_row(outcome, todo[outcome.key]))
    return [rows[key] for key in dict.fromkeys(keys)]


def failures(rows: Sequence[Row]) -> list[str]:
    """List the errors among ``rows``, one line each."""
    failed = [row for row in rows if row["error"] is not None]
    if not failed:
        return []
    name_of = names({row["key"]: row["spec"] for row in rows})
    return [f"{name_of[row['key']]}: {row['error']}" for row in failed]


def lost_runs(rows: Sequence[Row]) -> list[str]:
    """List the runs that were lost throughout; each result has ``frames`` and ``lost_share``."""
    found = []
    for row in finished(rows):
        frames, share = row["result"]["frames"], row["result"]["lost_share"]
        complaint = lost_throughout(frames, round(share * frames))
        if complaint:
            spec = row["spec"]
            found.append(f"sequence {spec['sequence']}, backend {spec['backend']}: {complaint}")
    return found


def names(specs: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Name specs for messages, by key.

    As in ``planner greedy, scene table, seed 2000``, then other fields that differ among them.
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
    """Refuse to continue if all rows failed, so that an empty report never replaces a good one.

    Raises:
        RuntimeError: quotes the first error.
    """
    errors = failures(rows)
    if rows and len(errors) == len(rows):
        raise RuntimeError(f"all {len(rows)} failed, the first: {errors[0]}; no report is written")


def _row(outcome: Done, spec: Any) -> Row:
    """Convert an outcome to the row that is recorded."""
    row: Row = {
        "key": outcome.key,
        "spec": dataclasses.asdict(spec),
        "result": outcome.value,
        "error": outcome.error,
    }
    if outcome.traceback:
        row["traceback"] = outcome.traceback
    return {**row, "elapsed_s": outcome.elapsed_s}


@dataclass(frozen=True)
class Outcome:
    """Outcome of running an experiment.

    Attributes:
        results: results, as written.
        failures: errors of failed rows and complaints about runs that were lost throughout, one
            line each.
    """

    results: Results
    failures: Sequence[str]


def run_experiment(
    experiment: Experiment, out: Path, workers: int | None = None, ray: str | None = None
) -> Outcome:
    """Run the rows that ``out`` lacks; write ``results.json``, ``table.md`` and figures.

    Args:
        experiment: experiment with its options.
        out: folder of the results; each finished row is saved there at once, in ``rows.jsonl``.
        workers: number of processes; None for the experiment's default.
        ray: address of a Ray cluster whose workers run the rows; None: processes of this machine.

    Raises:
        InputError: options with which no row could run, no cluster at the address, or another
            process working in ``out``.
        RuntimeError: every row failed; the files of an earlier run stay unchanged.
    """
    experiment = experiment.placed(out)
    specs = experiment.specs()
    if not specs:
        raise InputError(f"no {experiment.unit} to run: an option is an empty list")
    with alone_in(out):
        return _run_specs(experiment, specs, out, workers, ray)


def _run_specs(
    experiment: Experiment, specs: Sequence[Any], out: Path, workers: int | None, ray: str | None
) -> Outcome:
    experiment.prepare()
    rows = run_all(
        specs,
        type(experiment).run,
        out,
        experiment.workers if workers is None else workers,
        experiment.unit,
        ray=ray,
        fresh=experiment.fresh_process,
        environment=experiment.environment(),
        kind=_kind(experiment),
        parts=experiment.parts,
    )
    check_any_finished(rows)
    wrong = [*failures(rows), *(lost_runs(rows) if experiment.tracks else [])]
    return Outcome(write_all(experiment, rows, out), wrong)


def write_all(experiment: Experiment, rows: Sequence[Row], out: Path) -> Results:
    """Write the results made from the rows into folder ``out``."""
    # Left out: tracebacks hold local paths, the results have one version and one set of digests for
    # all rows, and file hashes only decide whether a row must be made again.
    left_out = ("traceback", "results_version", "files", "sources")
    known = [row["sources"] for row in rows if row.get("sources")]
    sources = joined(known) if len(known) == len(rows) else {}
    rows = [{k: v for k, v in row.items() if k not in left_out} for row in rows]
    rows = from_plain(to_plain(rows))
    return write_result_folder(
        out,
        RESULTS,
        kind=_kind(experiment),
        title=experiment.title(),
        about=experiment.about(),
        tables=[with_privilege(table) for table in experiment.tables(rows)],
        charts=experiment.charts(rows),
        rows=rows,
        rows_key=experiment.rows_key,
        content={"config": as_config(experiment), **experiment.content(rows)},
        sources=sources,
    )


def _kind(experiment: Experiment) -> str:
    return type(experiment).__module__.rpartition(".")[2]


def as_config(experiment: Any) -> dict[str, Any]:
    """Return the options of an experiment as JSON types."""
    names = [field.name for field in dataclasses.fields(experiment)]
    return {name: to_plain(getattr(experiment, name)) for name in names}


_FILE_NAMING = ("planner", "scene", "backend")  # fields of a spec whose texts may name files
_BETWEEN = re.compile(r"[,=\s]+")
_IN_MODULE = re.compile(r"[\w.]+:[\w.]+")


def file_hashes(spec: Any) -> dict[str, str]:
    """Hash the files named by a spec's planner, scene and backend; return the hashes by name.

    Options such as ``policy,path=FILE`` are included; ``module:Class`` names the source file of the
    module, without what it imports. Folders are ignored.
    """
    texts = [getattr(spec, name, None) for name in _FILE_NAMING]
    parts = [
        part
        for text in texts
        if isinstance(text, str)
        for part in _BETWEEN.split(text.removeprefix("command:"))
    ]
    hashes = {part: digest(path) for part in parts if (path := _file(part))}
    return {part: text for part, text in hashes.items() if text}


def digest(path: Path) -> str:
    """Return a digest of a file's bytes; empty if it is missing or cannot be read."""
    with suppress(OSError):
        found = path.stat()
        return _digest(path.resolve(), found.st_mtime_ns, found.st_size)
    return ""


@lru_cache(maxsize=1024)
def _digest(path: Path, _mtime: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def _file(part: str) -> Path | None:
    """Return the file that a part of a text names, if any."""
    with suppress(OSError, ValueError):  # a name too long, with a null byte
        if ("/" in part or "." in part) and Path(part).is_file():
            return Path(part)
    if _IN_MODULE.fullmatch(part):
        with suppress(ImportError, ValueError, AttributeError):
            found = find_spec(part.partition(":")[0])
            if found and found.has_location and found.origin:
                return Path(found.origin)
    return None
