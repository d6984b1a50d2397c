"""Check committed results by running some of their rows again with today's code."""

from __future__ import annotations

import math
import re
import time
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.command_runs import is_command
from ms_slam_env.benchmark.experiment import EXPERIMENTS, Experiment, experiment_class
from ms_slam_env.benchmark.rows import digest
from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError, one_line
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.discovery import find_results
from ms_slam_env.report.records import RecordFile, from_plain, to_plain
from ms_slam_env.report.results import Results
from ms_slam_env.report.sources import sources_of
from ms_slam_env.report.tables import finished

TOLERANCE = 0.02
"""Relative difference expected between processors: amplified rounding of the last bits."""
_SMALLEST = 1e-6
_FEW = 10
"""Counts below this must be equal; larger ones may differ by ``TOLERANCE``, and at least by one."""
_OTHERS_CODE = re.compile(r"(?!ms_slam_(env|baselines|agents)\b)[A-Za-z_][\w.]*:[A-Za-z_]")
"""Matches ``module:Class``, but not a sequence ``scene:seed``, which has a digit there."""


def check_results(
    cls: type[Experiment], committed: Results, rows: Sequence[Mapping[str, Any]] = ()
) -> tuple[int, list[str]]:
    """Run some committed rows again; return their count and a line for each value that differs.

    Without ``rows``, they are the cheapest for each value of the specification's first field (such
    as the planner). Only metrics that the registry marks as repeatable are compared.

    Raises:
        InputError: no finished rows, results of another experiment, or rows that do not fit the
            experiment's specification.
    """
    name = cls.__module__.rpartition(".")[2]
    if committed.kind != name:
        raise InputError(f"the committed results are of {committed.kind!r}, not of {name!r}")
    every = by_cost(committed)
    if not every:
        raise InputError(f"the committed results of {name!r} hold no rows that could be run again")
    different: dict[str, Any] = {}
    for row in every:
        different.setdefault(str(next(iter(row["spec"].values()))), row)
    chosen = list(different.values())
    chosen += [row for row in every if row not in chosen]
    chosen = list(rows) or chosen[: cls.check_rows]
    for row in chosen:
        _check_is_ours(row["spec"])
    differences = []
    for row in chosen:
        spec = from_dict(spec_type(cls), row["spec"])
        again = from_plain(to_plain(cls.run(spec)))
        what = ", ".join(f"{key} {value}" for key, value in row["spec"].items())
        differences += [f"{what}: {text}" for text in compare(row["result"], again)]
    return len(chosen), differences


def by_cost(committed: Results) -> list[Mapping[str, Any]]:
    """Return the finished rows, the cheapest first."""
    return sorted(finished(committed.rows), key=lambda row: row.get("elapsed_s", 0.0))


@dataclass(frozen=True)
class Checked:
    """What running the cheapest row of a record again has shown.

    Attributes:
        name: folder of the record.
        outcome: ``same``, ``differs``, or ``not run``.
        why: what differs, or why it was not run.
        older: whether the record is marked as older than the code, so that it may differ.
        seconds: time that it took.
    """

    name: str
    outcome: str
    why: str = ""
    older: bool = False
    seconds: float = 0.0


def check_records(folder: Path, out: Path, limit_s: float, row_s: float) -> Iterator[Checked]:
    """Run the cheapest row of every record again; cheap records come first.

    What has been checked with the same record and the same code is read from ``out``, so that an
    interrupted check goes on where it stopped.

    Args:
        folder: folder of the records.
        out: folder of ``checked.jsonl``.
        limit_s: stop running rows after so many seconds.
        row_s: records whose cheapest row took longer are not run.
    """
    checked = RecordFile(out / "checked.jsonl")
    before = checked.load()
    found = [(rows[0].get("elapsed_s", 0.0), one)
             for one in find_results(folder)[0] if (rows := by_cost(one.results))]  # fmt: skip
    start = time.monotonic()
    for cost, one in sorted(found, key=lambda pair: pair[0]):
        results = one.results
        name = one.path.parent.relative_to(folder).as_posix()
        text = str([results.content, [row["spec"] for row in results.rows]])
        key = f"{name} {digest(one.path)} {sorted(sources_of(results.kind, text).items())}"
        if key in before:
            yield Checked(**before[key]["checked"])
        elif results.kind not in EXPERIMENTS.own:
            yield Checked(name, "not run", f"{results.kind} is no experiment")
        elif cost > row_s:
            yield Checked(name, "not run", f"its cheapest row took {cost:.0f} s")
        elif time.monotonic() - start > limit_s:
            yield Checked(name, "not run", "the time is up")
        else:
            shown = _checked(name, results)
            if shown.outcome != "not run":
                checked.append({"key": key, "checked": to_plain(shown)})
            yield shown


def _checked(name: str, results: Results) -> Checked:
    """Run the cheapest row of a record again."""
    start = time.monotonic()
    differences: list[str] = []
    older = bool(results.stale)
    try:
        cls = experiment_class(results.kind)
        _, differences = check_results(cls, results, by_cost(results)[:1])
    except InputError as error:  # such as data that is not at hand
        return Checked(name, "not run", str(error), older)
    except Exception as error:
        differences = [f"{type(error).__name__}: {error}"]
    why = ""
    if differences:
        why = one_line(f"{len(differences)} values, as {differences[0].rpartition(': ')[2]}")
    return Checked(name, "differs" if why else "same", why, older, time.monotonic() - start)


def _check_is_ours(spec: Mapping[str, Any]) -> None:
    """Refuse a specification that names a program, or code from outside the package.

    Raises:
        InputError: names the program or the code.
    """
    for key, value in spec.items():
        for text in value if isinstance(value, (list, tuple)) else (value,):
            if isinstance(text, Mapping):
                _check_is_ours(text)
            elif isinstance(text, str) and (is_command(text) or _OTHERS_CODE.match(text)):
                raise InputError(
                    f"the committed results name code, {key} = {text[:80]!r}, which is not run"
                )


def spec_type(cls: type[Experiment]) -> type[Any]:
    """Return the type of the specification that ``run`` takes."""
    (hint, *_) = typing.get_type_hints(cls.run).values()
    return hint


def compare(before: Any, after: Any, where: str = "") -> list[str]:
    """List the values that differ by more than ``TOLERANCE``, at any depth, one line each."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        kept = {key: old for key, old in before.items() if metric(key).repeatable}
        missing = [f"{where}{key} is missing" for key in kept if key not in after]
        pairs = [(f"{where}{key}.", old, after[key]) for key, old in kept.items() if key in after]
    elif isinstance(before, list) and isinstance(after, list):
        missing = []
        if len(before) != len(after):
            return [f"{where[:-1]} had {len(before)} values, has {len(after)}"]
        pairs = [(f"{where}{i}.", *pair) for i, pair in enumerate(zip(before, after, strict=True))]
    else:
        return [] if _alike(before, after) else [f"{where[:-1]} was {before!r}, is {after!r}"]
    return missing + [text for name, old, new in pairs for text in compare(old, new, name)]


def _alike(old: Any, new: Any) -> bool:
    is_number = not isinstance(old, bool) and isinstance(old, (int, float))
    if is_number and not isinstance(new, bool) and isinstance(new, (int, float)):
        is_count = isinstance(old, int) and isinstance(new, int) and abs(old) >= _FEW
        return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=1 if is_count else _SMALLEST)
    return bool(old == new)


_FOLDERS = {"planners": "room_task"}  # folders not named after their experiment


def committed_results(name: str) -> Path:
    """Return the folder of an experiment's committed results, relative to the root of a clone."""
    return Path("docs") / "results" / _FOLDERS.get(name, name)
