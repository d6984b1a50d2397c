"""Pareto fronts at several frame rates, and so divergences, as in Figs. 5 and 6 of the paper."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ms_slam_experiments.shared.sampler_studies import explore_in_memory

from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Column, Row, Table, grouped, make_table
from ms_slam_env.slam.configuration import SlamConfiguration, read_configuration
from ms_slam_env.slam.surfel import SurfelConfig
from ms_slam_env.slam.surfel.surfel_config import PAPER
from ms_slam_env.tuning import SlamEvaluator, make_space
from ms_slam_env.tuning.objectives import FAILURE, as_metrics
from ms_slam_env.tuning.samplers import SAMPLERS

OBJECTIVES = ("ate_max_m", "ext_ms")
ERROR, COST = "ate_max_m", "cpu_ms_median"


def paper_configuration() -> SlamConfiguration:
    """ElasticFusion's published parameters."""
    paper = SurfelConfig.paper()
    options = {name: getattr(paper, name) for name in (*PAPER, "loop_closure")}
    return SlamConfiguration(slam_config=options)


@dataclass(frozen=True)
class FrontSpec:
    """One study at one frame rate; see :class:`ExploreRates` for the fields.

    Attributes:
        base: fields of the configuration that it starts from.
        seed: seed of the sampler.
    """

    keep_every: int
    sampler: str
    seed: int
    trials: int
    sequences: tuple[str, ...]
    parameters: tuple[str, ...]
    image_size: str
    frames: int
    base: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ExploreRates(Checked, Experiment):
    """Pareto fronts at several frame rates

    SLAM processes every n-th frame, which fixes the divergence between processed frames. At each
    rate, the parameters are explored (Saeedi et al., ICRA 2017, section IV-B, Figs. 5 and 6): at
    random, as in the paper, and by a sampler that learns.
    """

    keep_every: tuple[int, ...] = (1, 2, 3, 4)
    """Process one in this many frames; each value has its own front."""
    samplers: tuple[str, ...] = ("random", "tpe")
    """random, nsga2, tpe, gp, forest."""
    seeds: int = bounded(1, 1, 1000)
    """Studies of each sampler at each rate; a front contains all their trials."""
    trials: int = bounded(30, 1, 100_000)
    """Trials of each study, the default configuration first."""
    sequences: tuple[str, ...] = ("living_room:1000",)
    """Folders, or scene:seed[:word[+word ...]]."""
    parameters: tuple[str, ...] = ("paper",)
    """Parameters as in ms-slam explore; by default the paper's three."""
    config: Path | None = None
    """Configuration file (YAML) to start from; by default ElasticFusion's published parameters."""
    image_size: str = "160x120"
    """Image size of the camera."""
    frames: int = 90
    """Length of a whole rendered sequence."""

    unit = rows_key = "studies"
    workers = 1  # times are measured

    def specs(self) -> list[FrontSpec]:
        """Every rate with every sampler and seed."""
        if not (self.samplers and self.keep_every):
            raise InputError("no sampler or no rate given")
        check_each("sampler", self.samplers, SAMPLERS)
        base = paper_configuration() if self.config is None else read_configuration(self.config)
        SlamEvaluator(self.sequences, self.frames, image_size=self.image_size)  # refuses bad input
        make_space(self.parameters, base)
        return self.each(
            FrontSpec,
            keep_every=[
                dataclasses.replace(base, keep_every=n).keep_every for n in self.keep_every
            ],
            seed=range(self.seeds),
            sampler=self.samplers,
            base=(asdict(base),),
        )

    @staticmethod
    def run(spec: FrontSpec) -> dict[str, Any]:
        """Explore in memory; return the trials, the default first."""
        base = SlamConfiguration(**{**spec.base, "keep_every": spec.keep_every})
        space = make_space(tuple(spec.parameters), base)
        evaluator = SlamEvaluator(tuple(spec.sequences), spec.frames, image_size=spec.image_size)
        found = explore_in_memory(
            space,
            lambda values: evaluator(space.configuration(values)),
            OBJECTIVES,
            spec.sampler,
            spec.seed,
            spec.trials,
        )
        trials = [
            {"parameters": ", ".join(f"{name}={value}" for name, value in params.items()),
             **as_metrics(measured, evaluator.clock), "failed": bool(measured.get(FAILURE))}
            for params, measured in found
        ]  # fmt: skip
        return {"M_I": found[0][1].get("M_I"), "M_D": found[0][1].get("M_D"), "trials": trials}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """The default at each rate, and the improvements on each sampler's front."""
        lines = []
        for (every, sampler), results in _studies(rows).items():
            default = results[0]["trials"][0]
            front = front_of_trials(_trials(results))
            error, cost = default.get(ERROR), default.get(COST)  # none if it crashed
            no_slower = [t[ERROR] for t in front if cost is not None and t[COST] <= cost]
            no_worse = [t[COST] for t in front if error is not None and t[ERROR] <= error]
            lines.append({
                **{"keep_every": every, "sampler": sampler, "count": len(_trials(results))},
                **{name: results[0][name] for name in ("M_I", "M_D")},
                **{"default_error": error, "default_cost": cost},
                "error": min(no_slower, default=None),
                "cost": min(no_worse, default=None),
            })  # fmt: skip
        columns = (
            *("keep_every", "M_I", "M_D", "sampler", Column("count", "trials")),
            Column("default_error", ERROR, "largest error of the default"),
            Column("error", ERROR, "least in no more time"),
            Column("default_cost", COST, "time of the default"),
            Column("cost", COST, "least at no more error"),
        )
        note = "Each line: one frame rate, and so one divergence; the default is the first trial."
        return [make_table(columns, lines, note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """The fronts of all rates with their defaults, a panel per sampler."""
        drawn: dict[str, list[Series]] = {}
        for (every, sampler), results in _studies(rows).items():
            front, default = front_of_trials(_trials(results)), results[0]["trials"][0]
            drawn.setdefault(sampler, []).extend(
                [
                    _series(f"every {every}", front, "lines+markers"),
                    _series(f"default, every {every}", _trials([{"trials": [default]}]), "markers"),
                ]
            )
        caption = "A line: what no other trial of that frame rate beats."
        panels = [Panel(COST, ERROR, series, "xy", title=name) for name, series in drawn.items()]
        return [Chart("fronts", "Fronts of the frame rates", caption, panels)]


def _series(name: str, trials: Sequence[Row], mode: str) -> Series:
    """Error over time of trials."""
    x, y = ([trial[key] for trial in trials] for key in (COST, ERROR))
    return Series(name, x, y, mode=mode)


def _studies(rows: Sequence[Row]) -> dict[tuple[Any, ...], list[Row]]:
    """Results by rate and sampler."""
    return dict(sorted(grouped(rows, ("keep_every", "sampler")).items()))


def _trials(results: Sequence[Row]) -> list[Row]:
    return [trial for result in results for trial in result["trials"] if not trial["failed"]]


def front_of_trials(trials: Sequence[Row]) -> list[Row]:
    """Trials that none beats in error and cost, fastest first."""
    front: list[Row] = []
    for trial in sorted(trials, key=lambda t: (t[COST], t[ERROR])):
        if not front or trial[ERROR] < front[-1][ERROR]:
            front.append(trial)
    return front
