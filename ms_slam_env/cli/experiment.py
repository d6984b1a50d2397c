"""``ms-slam experiment NAME``."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from ms_slam_env._runtime.command_line import for_a_page, parse, report_failures
from ms_slam_env.benchmark import (
    EXPERIMENTS,
    HAS_RESEARCH,
    Experiment,
    experiment_class,
    run_experiment,
)
from ms_slam_env.benchmark.checking import check_records, check_results, committed_results
from ms_slam_env.benchmark.experiment import IN_A_CLONE
from ms_slam_env.report.results import RESULTS, read_results

ELSEWHERE = f"the research of the project is not installed: {IN_A_CLONE}"


def main(arguments: Sequence[str]) -> int:
    """List the experiments, or run one; return 1 if a row failed or a committed value differs."""
    if not arguments or arguments[0] in ("list", "-h", "--help"):
        print(listing())
        return 0 if arguments else 2
    name, *rest = arguments
    if name == "check":
        return check_all(parse(CheckArguments, rest, "ms-slam experiment check"))
    folder = Path("results") / name.replace(":", ".")
    return run(experiment_class(name), rest, f"ms-slam experiment {name}", folder)


def run(cls: type[Experiment], arguments: Sequence[str], program: str, out: Path) -> int:
    """Parse an experiment's options, run it and print its tables; ``out`` is the default folder."""
    args: Any = parse(with_run_options(cls, out), arguments, program)
    if args.check:
        return check(cls, args.committed)
    own = {field.name: getattr(args, field.name) for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    outcome = run_experiment(cls(**own), args.out, args.workers, args.ray)
    print(outcome.results.as_markdown())
    page = for_a_page(args.out)
    print(f"written: {args.out}/{RESULTS}, table.md and figures{page}", file=sys.stderr)
    return report_failures(outcome.failures)


def check(cls: type[Experiment], folder: Path) -> int:
    """Run some committed rows again and compare; return 1 if a value differs."""
    committed = read_results(folder / RESULTS)
    if committed.caveats:
        print(committed.caveats)
    count, differences = check_results(cls, committed)
    print("\n".join(differences) or f"{folder}: {count} rows run again, nothing differs")
    return 1 if differences else 0


@dataclasses.dataclass(frozen=True)
class CheckArguments:
    """Run the cheapest row of every committed record again, and list those that differ.

    Exit code 1 if a record differs that is not marked as older than the code. The same command
    goes on where an interrupted one stopped, until the code or the record changes.
    """

    records: Path = Path("docs/results")
    """Folder of the records."""
    out: Path = Path("results/check")
    """Folder that keeps what was checked."""
    limit_minutes: float = 60.0
    """Start no row after so many minutes."""
    row_seconds: float = 30.0
    """Leave out records whose cheapest row took longer when it was made."""


def check_all(args: CheckArguments) -> int:
    """Check every record; return 1 if one differs that is not marked as older than the code."""
    counts: dict[str, int] = {}
    args.out.mkdir(parents=True, exist_ok=True)
    for one in check_records(args.records, args.out, 60 * args.limit_minutes, args.row_seconds):
        label = f"{one.outcome}, as marked" if one.older and one.why else one.outcome
        label = one.outcome if one.outcome == "not run" else label
        counts[label] = counts.get(label, 0) + 1
        print(f"{one.name}: {label}{f': {one.why}' if one.why else ''}", flush=True)
    print("; ".join(f"{count} {label}" for label, count in sorted(counts.items())))
    return 1 if counts.get("differs") else 0


def with_run_options(cls: type[Experiment], out: Path) -> type[Any]:
    """Extend the experiment's dataclass with the options common to all experiments."""
    name = cls.__module__.rpartition(".")[2]
    options: list[tuple[str, Any, str, Any]] = [
        ("workers", int | None, "Parallel processes (default: the experiment's own).", None),
        ("out", Path, "Folder of the results; what it holds already is not run again.", out),
        ("ray", str | None, "Address of a Ray cluster whose workers run the rows, or local.", None),
        ("check", bool, "Run some committed rows again and compare.", False),
        (
            "committed",
            Path,
            "Folder of the results that --check compares.",
            committed_results(name),
        ),
    ]
    fields = [
        (key, Annotated[kind, tyro.conf.arg(help=text)], dataclasses.field(default=default))
        for key, kind, text, default in options
    ]
    own = {field.name for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    assert own.isdisjoint(key for key, *_ in options), f"{name} has an option that all have"
    made = dataclasses.make_dataclass(cls.__name__, fields, bases=(cls,), frozen=True)
    made.__doc__ = cls.__doc__
    return made


def listing() -> str:
    """List every experiment with its title."""
    names = EXPERIMENTS.names()
    width = max(map(len, names))
    return "\n".join(
        [
            "usage: ms-slam experiment NAME [options]; NAME --help lists the options",
            "       ms-slam experiment check runs a row of every committed record again",
            "",
            *(f"  {name:<{width}}  {experiment_class(name).title()}" for name in names),
            *(() if HAS_RESEARCH else ("", ELSEWHERE)),
        ]
    )
