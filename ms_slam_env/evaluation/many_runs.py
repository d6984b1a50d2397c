"""Compare many trajectory files with one truth: medians by system, box plots by delta."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.evaluation_report import Evaluation
from ms_slam_env.evaluation.rerun_file import write_paths
from ms_slam_env.evaluation.trajectory_charts import path_panel
from ms_slam_env.evaluation.trajectory_files import Matched, TrajectoryOptions, match_files
from ms_slam_env.evaluation.trajectory_measures import absolute, absolute_key, measure_matched
from ms_slam_env.metrics.registry import metric
from ms_slam_env.report import figures
from ms_slam_env.report.charts import Chart
from ms_slam_env.report.statistics import median_interval
from ms_slam_env.report.tables import Column, Table, Value, make_table

BOXES, PATHS = "errors.png", "runs.rrd"
_QUARTILES = {"percentile_5": 5, "quartile_25": 25, "median": 50, "quartile_75": 75,
              "percentile_95": 95}  # fmt: skip


@dataclass(frozen=True)
class Run:
    """One run of a system.

    Attributes:
        system: name of the system; results of runs with the same name are pooled.
        path: the TUM file.
        matched: its poses matched with the truth.
        found: its measures.
        relative: relative translation errors (K,) in metres, by delta.
    """

    system: str
    path: Path
    matched: Matched
    found: Mapping[str, Any]
    relative: Mapping[float, Float64]


def parse_run(text: str) -> tuple[str, Path]:
    """Split ``NAME=FILE`` into system and file; without NAME the file name is the system's.

    Raises:
        InputError: an empty name or file.
    """
    name, equals, file = text.partition("=")
    if not equals:
        name, file = Path(text).stem, text
    if not (name and file):
        raise InputError(f"run {text!r} is not FILE or NAME=FILE")
    return name, Path(file)


def evaluate_runs(
    texts: Sequence[str], truth: Path, options: TrajectoryOptions, deltas: Sequence[float] = ()
) -> Evaluation:
    """Compare runs with one truth by all measures, with relative errors over every delta.

    Args:
        texts: ``NAME=FILE`` each; runs with the same name belong to one system.
        truth: TUM file.
        options: as for one trajectory; ``delta_unit`` is the unit of ``deltas``.
        deltas: distances of the relative errors; that of the options if empty.

    Raises:
        InputError: as `match_files` and `measure_matched`, a file given twice, or no run.
    """
    if not texts:
        raise InputError("no run given")
    if len(set(texts)) < len(texts):
        raise InputError(f"a run is given twice: {', '.join(texts)}")
    asked = [replace(options, delta=delta) for delta in deltas or (options.delta,)]
    options = asked[0]
    runs = [_measured(*parse_run(text), truth, options, asked) for text in texts]
    tables = [systems_table(runs, options), boxes_table(runs, options), runs_table(runs, options)]
    paths = {"truth": max((run.matched.true_path for run in runs), key=len)}
    paths |= {name: matched.estimate[:, :3, 3] for name, matched in labelled(runs).items()}

    def write(out: Path) -> None:
        draw_boxes(runs, options, out / BOXES)

    return Evaluation(
        {"runs": [{"system": run.system, "estimate_file": str(run.path), **run.found}
                  for run in runs]},
        {"runs": list(texts), "truth": str(truth), "deltas": [o.delta for o in asked],
         **asdict(options)},
        tables[0].as_markdown(),
        tables,
        [Chart("trajectories", "Paths", "After alignment.", [path_panel(paths)])],
        write,
        lambda path: write_paths(path, labelled(runs)),
    )  # fmt: skip


def labelled(runs: Sequence[Run]) -> dict[str, Matched]:
    """Matched poses by run name: that of its system, numbered if the system has several runs."""
    systems = [run.system for run in runs]
    numbers = {name: itertools.count(1) for name in systems}
    found = {}
    for run in runs:
        number = f" {next(numbers[run.system])}" if systems.count(run.system) > 1 else ""
        found[run.system + number] = run.matched
    return found


def systems_table(runs: Sequence[Run], options: TrajectoryOptions) -> Table:
    """Medians over the runs of each system, with 95 % bootstrap intervals."""
    keys = _keys(options)
    lines = []
    for system in dict.fromkeys(run.system for run in runs):
        own = [run for run in runs if run.system == system]
        known = {key: [r.found[key] for r in own if r.found[key] is not None] for key in keys}
        lines.append({
            "system": system,
            "runs_count": len(own),
            **{key: median_interval(values) if values else None for key, values in known.items()},
        })  # fmt: skip
    poses, unmatched = (sum(r.found[key] for r in runs) for key in ("poses", "unmatched_poses"))
    note = (
        "Medians over the runs with 95 % bootstrap intervals; "
        f"{poses} of {poses + unmatched} poses have a true one."
    )
    return make_table(("system", "runs_count", *keys), lines, "Systems", note)


def boxes_table(runs: Sequence[Run], options: TrajectoryOptions) -> Table:
    """Quantiles of the relative errors over every delta, the runs of a system pooled."""
    lines: list[dict[str, Value]] = [
        {"system": system, "delta_text": _delta(delta, options), "pose_pairs": len(errors),
         **{name: float(np.percentile(errors, q)) for name, q in _QUARTILES.items()}}
        for (system, delta), errors in pooled(runs).items()
    ]  # fmt: skip
    columns = [Column(name, "rpe_m", heading=metric(name).heading) for name in _QUARTILES]
    note = f"Of all pairs of poses ({options.pairs}) of all runs of a system."
    return make_table(
        ("system", "delta_text", "pose_pairs", *columns), lines, "Relative errors", note
    )


def runs_table(runs: Sequence[Run], options: TrajectoryOptions) -> Table:
    """Table of all runs."""
    keys = ("poses", "unmatched_poses", *_keys(options))
    lines = [{"system": run.system, "estimate_file": run.path.name, **run.found} for run in runs]
    return make_table(("system", "estimate_file", *keys), lines, "Runs")


def pooled(runs: Sequence[Run]) -> dict[tuple[str, float], Float64]:
    """Relative errors (K,) of all runs of a system, by system and delta."""
    together: dict[tuple[str, float], list[Float64]] = {}
    for run in runs:
        for delta, errors in run.relative.items():
            together.setdefault((run.system, delta), []).append(errors)
    return {key: np.concatenate(parts) for key, parts in together.items()}


def draw_boxes(runs: Sequence[Run], options: TrajectoryOptions, path: Path) -> Path:
    """Box plots: absolute errors by system, then relative errors by system for every delta.

    Boxes are the quartiles, whiskers the 5th and 95th percentiles.
    """
    systems = list(dict.fromkeys(run.system for run in runs))
    panels = {metric(absolute_key(options, "m")).label: [
        np.concatenate([absolute(run.matched)[0] for run in runs if run.system == system])
        for system in systems
    ]}  # fmt: skip
    found = pooled(runs)
    for delta in runs[0].relative:
        label = f"{metric('rpe_m').label}, {_delta(delta, options)}"
        panels[label] = [found[system, delta] for system in systems]
    figure = figures.new_figure(len(panels))
    axes = np.atleast_1d(figure.subplots(1, len(panels)))
    for ax, (label, boxes) in zip(axes, panels.items(), strict=True):
        ax.boxplot([1e3 * box for box in boxes], whis=(5, 95), showfliers=False)
        ax.set_xticks(range(1, len(systems) + 1), systems, rotation=30, ha="right")
        ax.set_ylabel(label)
    figures.caption(figure, "Boxes: quartiles; whiskers: 5 % and 95 %; runs of a system pooled.")
    return figures.save(figure, path)


def _measured(
    system: str,
    path: Path,
    truth: Path,
    options: TrajectoryOptions,
    asked: Sequence[TrajectoryOptions],
) -> Run:
    try:
        matched = match_files(path, truth, options)
        relative = {
            one.delta: metrics.relative_errors(
                matched.estimate, matched.truth, times=matched.times, **one.relative
            )
            for one in asked
        }
        return Run(system, path, matched, measure_matched(matched, options), relative)
    except InputError as error:
        named = str(path) in str(error)
        raise error if named else InputError(f"{path}: {error}") from None


def _keys(options: TrajectoryOptions) -> tuple[str, ...]:
    errors = (absolute_key(options, "m"), absolute_key(options, "rad"), "rpe_m", "rpe_rad")
    return (*errors, "lost_s", "covered_share")


def _delta(delta: float, options: TrajectoryOptions) -> str:
    return f"{delta:g} {options.delta_unit}"
