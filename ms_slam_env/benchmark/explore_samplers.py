"""Do samplers that learn beat random ones? Hypervolume at equal numbers of trials.

Every sampler explores the same space on the same sequences with several seeds, in turn, so that
none has a quieter machine. Run as ``python -m ms_slam_env.benchmark.explore_samplers --help``;
interrupted and called again, it goes on.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ms_slam_env.benchmark.command_line import exit_code, parse
from ms_slam_env.benchmark.explore_evaluation import SlamEvaluator
from ms_slam_env.benchmark.explore_figures import hypervolume_figure
from ms_slam_env.benchmark.figures import save
from ms_slam_env.benchmark.provenance import provenance
from ms_slam_env.benchmark.records import write_json
from ms_slam_env.benchmark.statistics import bootstrap_interval
from ms_slam_env.benchmark.table import markdown_table
from ms_slam_env.errors import InputError
from ms_slam_env.exploration import ExplorationSettings, SearchSpace, explore, make_space
from ms_slam_env.exploration.front import hypervolume_history, points_of
from ms_slam_env.exploration.samplers import SAMPLERS

PROGRAM = "python -m ms_slam_env.benchmark.explore_samplers"
BASELINE = "random"
_AT_A_TIME = 20  # trials of one study before the next has its turn


@dataclass(frozen=True)
class Arguments:
    """Hypervolume over trials, sampler by sampler."""

    samplers: tuple[str, ...] = tuple(SAMPLERS)
    """random, nsga2, tpe, gp; the first is what the others are compared with."""
    seeds: int = 5
    """Studies of each sampler."""
    trials: int = 40
    """Finished trials of each study."""
    sequences: tuple[str, ...] = ("living_room:1000",)
    """Folders, or scene:seed[:noise[+perturbation ...]]."""
    parameters: tuple[str, ...] = ("algorithm",)
    """As of ms-slam explore."""
    image_size: str = "80x60"
    """Of the camera."""
    frames: int = 40
    """Length of a rendered sequence."""
    reference_factor: float = 2.0
    """The hypervolume counts from so many times the default's figures."""
    out: Path = Path("results/explore_samplers")
    """Folder of the studies and the results."""


def run(arguments: Arguments) -> str:
    """Explore, write ``samplers.json``, ``table.md``, ``hypervolume.png``; return the table."""
    if arguments.seeds < 1 or arguments.trials < 1 or not arguments.samplers:
        raise InputError("samplers, seeds and trials must be 1 or more")
    evaluator = SlamEvaluator(
        arguments.sequences, arguments.frames, image_size=arguments.image_size
    )
    space = make_space(arguments.parameters)
    reference = _reference(evaluator, space, arguments)
    histories: dict[str, list[list[float]]] = {name: [] for name in arguments.samplers}
    done = {}
    total = len(arguments.samplers) * arguments.seeds * arguments.trials
    with tqdm(total=total, unit="trial") as bar:
        for seed in range(arguments.seeds):
            budgets = [*range(_AT_A_TIME, arguments.trials, _AT_A_TIME), arguments.trials]
            for budget in budgets:
                for name in arguments.samplers:
                    settings = ExplorationSettings(
                        sampler=name,
                        seed=seed,
                        reference=reference,
                        context=evaluator.context(),
                    )
                    folder = arguments.out / "studies" / f"{name}-{seed}"
                    ledger = explore(folder, space, settings, evaluator, budget)
                    done[name, seed] = budget
                    bar.update(sum(done.values()) - bar.n)
                    if budget == arguments.trials:
                        points = points_of(ledger)
                        history = hypervolume_history(points, reference, settings.objectives)
                        histories[name].append([float(value) for value in history])
    content = {
        "provenance": provenance(),
        "config": {name: getattr(arguments, name) for name in Arguments.__dataclass_fields__}
        | {"out": str(arguments.out), **asdict(evaluator)},
        "reference": reference,
        "summary": summarise(histories),
        "hypervolume": histories,
    }
    write_json(arguments.out / "samplers.json", content)
    text = table(content["summary"])  # type: ignore[arg-type]
    (arguments.out / "table.md").write_text(text, encoding="utf-8")
    save(hypervolume_figure(histories), arguments.out / "hypervolume.png")
    return text


def _reference(
    evaluator: SlamEvaluator, space: SearchSpace, arguments: Arguments
) -> dict[str, float]:
    """One reference for every study: multiples of the default's figures, kept in a file."""
    path = arguments.out / "reference.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    runs = [evaluator(space.base) for _ in range(3)]
    reference = {
        name: arguments.reference_factor * float(np.median([row[name] for row in runs]))
        for name in ExplorationSettings().objectives
    }
    write_json(path, reference)
    return reference


def summarise(histories: Mapping[str, Sequence[Sequence[float]]]) -> list[dict[str, Any]]:
    """A row a sampler: final and half-way hypervolume, and by how much it exceeds the first's.

    Seeds are paired: studies of one seed have had the same machine at the same time.
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
