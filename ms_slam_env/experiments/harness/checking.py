"""Are committed results what the code makes today? Some of their rows are run again."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ms_slam_env.config import from_dict
from ms_slam_env.experiments.harness.experiment import Experiment
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report.records import from_plain, to_plain
from ms_slam_env.report.results import Results
from ms_slam_env.report.tables import finished

TOLERANCE = 0.02
"""Relative difference that other processors cause: rounding of the last bits, amplified."""
_SMALLEST = 1e-4


def check_results(cls: type[Experiment], committed: Results) -> list[str]:
    """Run the cheapest committed rows again; one line for each metric that differs.

    Only metrics that the registry calls repeatable are compared.

    Raises:
        InputError: rows that the experiment has no specification for.
    """
    rows = sorted(finished(committed.rows), key=lambda row: row["elapsed_s"])
    differences = []
    for row in rows[: cls.check_rows]:
        spec = from_dict(spec_type(cls), row["spec"])
        again = from_plain(to_plain(cls.run(spec)))
        name = ", ".join(f"{key} {value}" for key, value in row["spec"].items())
        differences += [f"{name}: {text}" for text in compare(row["result"], again)]
    return differences


def spec_type(cls: type[Experiment]) -> type[Any]:
    """The dataclass that ``run`` takes."""
    (hint, *_) = typing.get_type_hints(cls.run).values()
    return hint


def compare(before: Mapping[str, Any], after: Mapping[str, Any], path: str = "") -> list[str]:
    """What differs between two results beyond ``TOLERANCE``, one line a metric."""
    differences = []
    for key, old in before.items():
        if not metric(key).repeatable:
            continue
        where = f"{path}{key}"
        if key not in after:
            differences.append(f"{where} is missing")
        elif not _alike(old, after[key]):
            differences.append(f"{where} was {old!r}, is {after[key]!r}")
    return differences


def _alike(old: Any, new: Any) -> bool:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        return not compare(old, new)
    if isinstance(old, Sequence) and not isinstance(old, str):
        return (
            isinstance(new, Sequence)
            and len(old) == len(new)
            and all(map(_alike, old, new))
        )  # fmt: skip
    if isinstance(old, float) and isinstance(new, (int, float)):
        return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=_SMALLEST)
    return old == new


def committed_results(name: str) -> Path:
    """Where the results of an experiment are committed, seen from the root of a clone."""
    return Path("docs") / "results" / name
