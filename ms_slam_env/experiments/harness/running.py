"""Run an experiment: what is missing in parallel, then everything that is made of the rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.errors import InputError
from ms_slam_env.experiments.harness.experiment import Experiment
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, lost_runs, run_all
from ms_slam_env.report.records import Row, from_plain, to_plain
from ms_slam_env.report.results import RESULTS, Results, write_result_folder


@dataclass(frozen=True)
class Outcome:
    """What a run of an experiment came to.

    Attributes:
        results: as written.
        failures: errors of the rows that failed and complaints of the others, one line each.
    """

    results: Results
    failures: Sequence[str]


def run_experiment(
    experiment: Experiment, out: Path, workers: int | None = None, ray: str | None = None
) -> Outcome:
    """Run the rows that ``out`` does not hold yet; write ``results.json``, ``table.md``, figures.

    Args:
        experiment: with its options.
        out: folder of the results; finished rows stand there at once, in ``rows.jsonl``.
        workers: processes; None for the experiment's own default.
        ray: address of a Ray cluster whose workers run the rows; None: processes of this machine.

    Raises:
        InputError: options that no row could be run with, or no cluster at the address.
        RuntimeError: every row failed; the files of an earlier run are left as they are.
    """
    specs = experiment.specs()
    if not specs:
        raise InputError(f"no {experiment.unit} to run: an option is an empty list")
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
    )
    check_any_finished(rows)
    wrong = [*failures(rows), *(lost_runs(rows) if experiment.tracks else [])]
    return Outcome(write_all(experiment, rows, out), wrong)


def write_all(experiment: Experiment, rows: Sequence[Row], out: Path) -> Results:
    """Write everything that is made of the rows into folder ``out``."""
    rows = from_plain(to_plain(rows))
    return write_result_folder(
        out,
        RESULTS,
        lambda folder: experiment.write_pictures(rows, folder),
        kind=type(experiment).__module__.rpartition(".")[2],
        title=experiment.title(),
        about=experiment.about(),
        tables=experiment.tables(rows),
        charts=experiment.charts(rows),
        rows=rows,
        rows_key=experiment.rows_key,
        content={"config": as_config(experiment), **experiment.content(rows)},
    )


def as_config(experiment: Any) -> dict[str, Any]:
    """The options of an experiment as JSON's types."""
    names = [field.name for field in dataclasses.fields(experiment)]
    return {name: to_plain(getattr(experiment, name)) for name in names}
