"""Compare the chosen configurations with the default on the same sequences.

The comparison uses sequences that the exploration never saw, and its own once more, because a
configuration that was measured once may be the best by chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.errors import InputError
from ms_slam_env.report.records import RecordFile, spec_key
from ms_slam_env.report.statistics import bootstrap_interval
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning.evaluator import Row, SlamEvaluator, worst_ratio
from ms_slam_env.tuning.objectives import FAILURE, METRICS, key_of
from ms_slam_env.tuning.study_check import is_measured

DEFAULT = "default"
COMPARED = ("ate_m", "ext_ms", "load_ms")
"""Metrics by which configurations are compared."""


@dataclass(frozen=True)
class _Run:
    """One configuration on one sequence: the inputs that determine its result, and so its key."""

    evaluator: SlamEvaluator
    configuration: SlamConfiguration
    sequence: str


def compare_configurations(
    evaluator: SlamEvaluator,
    configurations: Mapping[str, SlamConfiguration],
    sequences: Sequence[str],
    path: Path,
) -> list[dict[str, Any]]:
    """Run every configuration on every sequence, interleaved so that machine load affects all.

    Runs already in the file ``path`` are not repeated.

    Raises:
        InputError: the file holds something else.

    Returns:
        a line for each configuration: the keys of ``COMPARED`` (means over the sequences); with
        the suffix ``_ratio``, the interval of their ratio to the default's, by a bootstrap over the
        sequences; ``worst_ate_ratio``, ``failed_runs`` and ``sequences_count``. Sequences on which
        either failed are left out of means and ratios.
    """
    records = RecordFile(path)
    done = records.load()
    for key, row in done.items():  # the file is untrusted
        if not is_measured(row):
            raise InputError(f"{path}: row {key} holds no measures of a run")
    rows: dict[str, list[Row]] = {name: [] for name in configurations}
    for sequence in sequences:
        for name, configuration in configurations.items():
            key = spec_key(_Run(evaluator, configuration, sequence))
            if key not in done:
                measured = evaluator.measure(configuration, sequence)
                done[key] = {"key": key, "configuration": asdict(configuration), **measured}
                records.append(done[key])
            rows[name].append(done[key])
    if not sequences:
        return []
    return [_line(name, own, rows[DEFAULT], evaluator.clock) for name, own in rows.items()]


def _line(name: str, own: Sequence[Row], default: Sequence[Row], clock: str) -> dict[str, Any]:
    pairs = [(a, b) for a, b in zip(own, default, strict=True) if _usable(a) and _usable(b)]
    line: dict[str, Any] = {
        "configuration": name.replace("_", " "),
        "sequences_count": len(own),
        "failed_runs": sum(not _usable(row) for row in own),
        "worst_ate_ratio": worst_ratio(*zip(*pairs, strict=True)) if pairs else None,
    }
    for compared in COMPARED:
        key, scale = key_of(compared, clock), METRICS[compared].scale
        mine = np.array([row[compared] for row, _ in pairs])
        theirs = np.array([row[compared] for _, row in pairs])
        line[key] = scale * float(mine.mean()) if len(mine) else None
        line[f"{key}_ratio"] = bootstrap_interval((mine, theirs), _ratio_of_means)
    return line


def _ratio_of_means(x: Any, y: Any, axis: int) -> Any:
    return np.mean(x, axis=axis) / np.mean(y, axis=axis)


def _usable(row: Row) -> bool:
    return not row.get(FAILURE) and all(row.get(name) is not None for name in COMPARED)
