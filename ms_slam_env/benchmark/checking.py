"""Check committed results by running some of their rows again with today's code."""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.command_runs import is_command
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.records import from_plain, to_plain
from ms_slam_env.report.results import Results
from ms_slam_env.report.tables import finished

TOLERANCE = 0.02
"""Relative difference expected between processors: amplified rounding of the last bits."""
_SMALLEST = 1e-6
_OTHERS_CODE = re.compile(r"(?!ms_slam_(env|baselines|agents)\b)[A-Za-z_][\w.]*:[A-Za-z_]")
"""Matches ``module:Class``, but not a sequence ``scene:seed``, which has a digit there."""


def check_results(cls: type[Experiment], committed: Results) -> tuple[int, list[str]]:
    """Run some committed rows again; return their count and a line for each value that differs.

    The rows are the cheapest for each value of the specification's first field (such as the
    planner). Only metrics that the registry marks as repeatable are compared.

    Raises:
        InputError: no finished rows, results of another experiment, or rows that do not fit the
            experiment's specification.
    """
    name = cls.__module__.rpartition(".")[2]
    if committed.kind != name:
        raise InputError(f"the committed results are of {committed.kind!r}, not of {name!r}")
    rows = sorted(finished(committed.rows), key=lambda row: row.get("elapsed_s", 0.0))
    if not rows:
        raise InputError(f"the committed results of {name!r} hold no rows that could be run again")
    different: dict[str, Any] = {}
    for row in rows:
        different.setdefault(str(next(iter(row["spec"].values()))), row)
    chosen = list(different.values())
    chosen += [row for row in rows if row not in chosen]
    chosen = chosen[: cls.check_rows]
    for row in chosen:
        _check_is_ours(row["spec"])
    differences = []
    for row in chosen:
        spec = from_dict(spec_type(cls), row["spec"])
        again = from_plain(to_plain(cls.run(spec)))
        what = ", ".join(f"{key} {value}" for key, value in row["spec"].items())
        differences += [f"{what}: {text}" for text in compare(row["result"], again)]
    return len(chosen), differences


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
        return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=_SMALLEST)
    return bool(old == new)


_FOLDERS = {"planners": "room_task"}  # folders not named after their experiment


def committed_results(name: str) -> Path:
    """Return the folder of an experiment's committed results, relative to the root of a clone."""
    return Path("docs") / "results" / _FOLDERS.get(name, name)
