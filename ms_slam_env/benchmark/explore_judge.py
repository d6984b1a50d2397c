"""The chosen configurations against the default, on sequences that the exploration never saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark.explore_evaluation import Row, SlamEvaluator
from ms_slam_env.exploration.objectives import FAILURE
from ms_slam_env.report.records import RecordFile, spec_key
from ms_slam_env.report.statistics import bootstrap_interval
from ms_slam_env.slam.configuration import SlamConfiguration

DEFAULT = "default"
FIGURES = ("ate_m", "ext_ms", "load_ms")


@dataclass(frozen=True)
class _Run:
    """One configuration on one sequence; what decides its result, and so its key."""

    evaluator: SlamEvaluator
    configuration: SlamConfiguration
    sequence: str


def judge(
    evaluator: SlamEvaluator,
    configurations: Mapping[str, SlamConfiguration],
    sequences: Sequence[str],
    out: Path,
) -> list[dict[str, Any]]:
    """Run every configuration on every sequence, in turn, so that none has a quieter machine.

    Runs that are on disk already are not repeated.

    Returns:
        a row for each configuration: ``ate_m``, ``ext_ms``, ``load_ms`` (means over the sequences),
        ``ate_m_ratio`` and so on of these to the default's with ``_low`` and ``_high`` of the 95 %
        bootstrap interval over the sequences, ``failed`` (number of sequences), ``sequences``.
        Sequences on which either failed have no part in means and ratios.
    """
    records = RecordFile(out / "held_out.jsonl")
    done = records.load()
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
    return [_summary(name, own, rows[DEFAULT]) for name, own in rows.items()]


def _summary(name: str, own: Sequence[Row], default: Sequence[Row]) -> dict[str, Any]:
    pairs = [(a, b) for a, b in zip(own, default, strict=True) if _usable(a) and _usable(b)]
    result: dict[str, Any] = {
        "configuration": name,
        "sequences": len(own),
        "failed": sum(not _usable(row) for row in own),
    }
    for figure in FIGURES:
        mine = np.array([row[figure] for row, _ in pairs])
        theirs = np.array([row[figure] for _, row in pairs])
        ratio = bootstrap_interval((mine, theirs), _ratio_of_means)
        result |= {
            figure: float(mine.mean()) if len(mine) else None,
            f"{figure}_ratio": ratio.value,
            f"{figure}_ratio_low": ratio.low,
            f"{figure}_ratio_high": ratio.high,
        }
    return result


def _ratio_of_means(x: Any, y: Any, axis: int) -> Any:
    return np.mean(x, axis=axis) / np.mean(y, axis=axis)


def _usable(row: Row) -> bool:
    return not row.get(FAILURE) and all(row.get(figure) is not None for figure in FIGURES)
