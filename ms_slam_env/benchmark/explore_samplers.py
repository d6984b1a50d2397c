"""Do samplers that learn beat random ones? Hypervolume at equal numbers of trials.

Many studies of every sampler need many evaluations. So each proposal is moved to the nearest point
of a grid, ten thousand points and more for seven parameters, and what has been measured at a point
is not measured again: every study of every sampler then explores one and the same function. Run as
``python -m ms_slam_env.benchmark.explore_samplers --help``; measurements and finished studies are
kept, and what is interrupted goes on from there, also with more seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ms_slam_env.benchmark.explore_evaluation import SlamEvaluator
from ms_slam_env.benchmark.explore_figures import hypervolume_figure
from ms_slam_env.benchmark.explore_grid import Grid
from ms_slam_env.benchmark.figures import save
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.errors import InputError
from ms_slam_env.exploration import make_space
from ms_slam_env.exploration.front import hypervolume
from ms_slam_env.exploration.objectives import FAILURE, objective_values
from ms_slam_env.exploration.settings import SAMPLERS, make_sampler
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import RecordFile, spec_key, write_json
from ms_slam_env.report.statistics import bootstrap_interval
from ms_slam_env.report.tables import markdown_table

PROGRAM = "python -m ms_slam_env.benchmark.explore_samplers"
OBJECTIVES = ("ate_m", "load_ms")
PARAMETERS = (
    "depth_cutoff_m=1:10:log",
    "icp_rgb_weight=0:1",
    "iterations.0=0:10",
    "points_per_level=500:16000:log",
    "surfel_radius_px=0.5:2",
    "unstable_window=10:400:log",
    "keep_every=1:6",
)
_POPULATION = 10  # of NSGA-II: several generations within a budget of tens


@dataclass(frozen=True)
class Arguments:
    """Hypervolume over trials, sampler by sampler."""

    samplers: tuple[str, ...] = tuple(SAMPLERS)
    """random, nsga2, tpe, gp; the first is what the others are compared with."""
    seeds: int = 6
    """Studies of each sampler."""
    trials: int = 40
    """Finished trials of each study."""
    sequences: tuple[str, ...] = ("living_room:1000",)
    """Folders, or scene:seed[:noise[+perturbation ...]]."""
    parameters: tuple[str, ...] = PARAMETERS
    """As of ms-slam explore, with ranges."""
    levels: int = 4
    """Points of the grid along each parameter; a range of integers may hold fewer."""
    image_size: str = "160x120"
    """Of the camera."""
    frames: int = 48
    """Length of a rendered sequence."""
    reference_factor: float = 2.0
    """The hypervolume counts from so many times the default's figures."""
    out: Path = Path("results/explore_samplers")
    """Folder of the measurements and the results."""


@dataclass(frozen=True)
class _Study:
    """A study; what decides its history."""

    evaluator: SlamEvaluator
    grid: dict[str, list[Any]]
    sampler: str
    seed: int
    trials: int
    reference: dict[str, float]


def run_study(
    grid: Grid, sampler: str, seed: int, trials: int, reference: Mapping[str, float]
) -> list[float]:
    """Explore in memory; return the hypervolume after every trial, as a share of the box."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        directions=["minimize"] * len(OBJECTIVES), sampler=make_sampler(sampler, seed, _POPULATION)
    )
    study.enqueue_trial(grid.space.defaults())
    kept: list[list[float]] = []
    history = []
    for _ in range(trials):
        trial = study.ask(grid.space.distributions())
        measured = grid(trial.params)
        values = objective_values(measured, OBJECTIVES, reference)
        trial.set_constraint("failed", 1.0 if measured.get(FAILURE) else 0.0)
        study.tell(trial, values)
        if not measured.get(FAILURE):
            kept.append([v / reference[n] for v, n in zip(values, OBJECTIVES, strict=True)])
        history.append(hypervolume(kept, [1.0] * len(OBJECTIVES)))
    return history


def run(arguments: Arguments) -> str:
    """Explore, write ``samplers.json``, ``table.md``, ``hypervolume.png``; return the table."""
    if min(arguments.seeds, arguments.trials, len(arguments.samplers)) < 1 or arguments.levels < 2:
        raise InputError("samplers, seeds and trials must be 1 or more, levels 2 or more")
    evaluator = SlamEvaluator(
        arguments.sequences, arguments.frames, image_size=arguments.image_size
    )
    space = make_space(arguments.parameters)
    grid = Grid(space, evaluator, arguments.levels, arguments.out / "evaluations.jsonl")
    default = grid(space.defaults())
    if default.get(FAILURE):
        raise InputError(f"the default configuration failed: {default[FAILURE]}")
    reference = {name: arguments.reference_factor * default[name] for name in OBJECTIVES}
    histories: dict[str, list[list[float]]] = {name: [] for name in arguments.samplers}
    pairs = [(seed, name) for seed in range(arguments.seeds) for name in arguments.samplers]
    records = RecordFile(arguments.out / "studies.jsonl")
    done = records.load()
    for seed, name in tqdm(pairs, unit="study"):
        key = spec_key(_Study(evaluator, grid.levels, name, seed, arguments.trials, reference))
        if key not in done:
            history = run_study(grid, name, seed, arguments.trials, reference)
            done[key] = {"key": key, "sampler": name, "seed": seed, "hypervolume": history}
            records.append(done[key])
        histories[name].append(done[key]["hypervolume"])
    content = {
        "provenance": provenance(),
        "config": {
            **asdict(evaluator),
            **asdict(arguments),
            "out": str(arguments.out),
            "grid": grid.levels,
        },
        "reference": reference,
        "points_measured": grid.measured,
        "points_of_the_grid": grid.size,
        "summary": summarise(histories),
        "hypervolume": histories,
    }
    write_json(arguments.out / "samplers.json", content)
    text = table(content["summary"])  # type: ignore[arg-type]
    (arguments.out / "table.md").write_text(text, encoding="utf-8")
    save(hypervolume_figure(histories), arguments.out / "hypervolume.png")
    return text


def summarise(histories: Mapping[str, Sequence[Sequence[float]]]) -> list[dict[str, Any]]:
    """A row a sampler: final and half-way hypervolume, and by how much it exceeds the first's.

    Intervals are of the mean over the seeds, 95 %, bootstrapped; differences are of equal seeds.
    """
    baseline = np.array(next(iter(histories.values())))
    rows = []
    for name, runs in histories.items():
        values = np.array(runs)
        row: dict[str, Any] = {"sampler": name, "seeds": len(values), "trials": values.shape[1]}
        for label, column in (("half", values.shape[1] // 2 - 1), ("end", -1)):
            mean = bootstrap_interval((values[:, column],), _mean)
            gain = bootstrap_interval((values[:, column] - baseline[:, column],), _mean)
            row |= _flat(f"hypervolume_{label}", mean) | _flat(f"gain_{label}", gain)
        row["wins"] = int(np.sum(values[:, -1] > baseline[:, -1]))
        rows.append(row)
    return rows


def _mean(x: Any, axis: int) -> Any:
    return np.mean(x, axis=axis)


def _flat(name: str, interval: Any) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: one line a sampler."""
    first = rows[0]
    header = [
        "sampler",
        f"hypervolume after {first['trials'] // 2}",
        f"after {first['trials']}",
        f"more than {first['sampler']}",
        "better in",
    ]
    return markdown_table(
        header,
        [
            [
                row["sampler"],
                _interval(row, "hypervolume_half"),
                _interval(row, "hypervolume_end"),
                "-" if row is first else _interval(row, "gain_end"),
                "-" if row is first else f"{row['wins']} of {row['seeds']}",
            ]
            for row in rows
        ],
    )


def _interval(row: Mapping[str, Any], name: str) -> str:
    value, low, high = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    sign = "+" if name.startswith("gain") else ""
    return f"{value:{sign}.3f} [{low:{sign}.3f}, {high:{sign}.3f}]"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print the table."""
    print(run(parse(Arguments, arguments, PROGRAM)))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
