"""Do samplers that learn beat random sampling? Hypervolume at equal numbers of trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.shared.sampler_studies import Grid, explore_in_memory

from ms_slam_env.benchmark.experiment import Experiment, check_each
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.statistics import Interval, bootstrap_interval
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table
from ms_slam_env.tuning import SlamEvaluator, make_space
from ms_slam_env.tuning.front import hypervolume
from ms_slam_env.tuning.objectives import FAILURE, objective_values
from ms_slam_env.tuning.samplers import SAMPLERS

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


@dataclass(frozen=True)
class StudySpec:
    """One study; see :class:`ExploreSamplers` for the fields."""

    sampler: str
    seed: int
    trials: int
    sequences: tuple[str, ...]
    parameters: tuple[str, ...]
    levels: int
    image_size: str
    frames: int
    reference_factor: float
    evaluations: str

    def grid(self) -> Grid:
        """The function to explore, the same for all studies of a process."""
        return _grid(
            tuple(self.parameters),
            SlamEvaluator(tuple(self.sequences), self.frames, image_size=self.image_size),
            self.levels,
            self.evaluations,
        )


@lru_cache(maxsize=1)
def _grid(
    parameters: tuple[str, ...], evaluator: SlamEvaluator, levels: int, evaluations: str
) -> Grid:
    return Grid(make_space(parameters), evaluator, levels, Path(evaluations))


@dataclass(frozen=True)
class ExploreSamplers(Checked, Experiment):
    """Samplers of an exploration

    Compares how fast the Pareto front grows with different samplers of configurations. Each
    proposal is moved to the nearest point of a grid (over ten thousand points for seven
    parameters), and each point is measured only once, so that all studies explore the same
    function.
    """

    samplers: tuple[str, ...] = tuple(SAMPLERS)
    """random, nsga2, tpe, gp, forest; the others are compared with the first."""
    seeds: int = bounded(6, 1, 1000)
    """Studies of each sampler."""
    trials: int = bounded(40, 1, 100_000)
    """Finished trials of each study."""
    sequences: tuple[str, ...] = ("living_room:1000",)
    """Folders, or scene:seed[:word[+word ...]]."""
    parameters: tuple[str, ...] = PARAMETERS
    """Parameters as in ms-slam explore, with ranges."""
    levels: int = bounded(4, 2, 1000)
    """Points of the grid along each parameter; a range of integers may have fewer."""
    image_size: str = "160x120"
    """Image size of the camera."""
    frames: int = 48
    """Length of a rendered sequence."""
    reference_factor: float = 2.0
    """Reference point of the hypervolume, as a multiple of the default's values."""
    evaluations: Path = Path("results/explore_samplers/evaluations.jsonl")
    """File of measured points, shared by all studies, including later ones."""

    unit = rows_key = "studies"
    workers = 1  # times are measured, and points only once

    def specs(self) -> list[StudySpec]:
        """Every sampler with every seed."""
        if not self.samplers:
            raise InputError("no sampler given")
        check_each("sampler", self.samplers, SAMPLERS)
        file = (str(self.evaluations),)
        return self.each(StudySpec, seed=range(self.seeds), sampler=self.samplers, evaluations=file)

    def prepare(self) -> None:
        """Refuse parameters without an order."""
        self.specs()[0].grid()

    @staticmethod
    def run(spec: StudySpec) -> dict[str, Any]:
        """Explore in memory."""
        grid = spec.grid()
        default = grid(grid.space.defaults())
        if default.get(FAILURE):
            raise InputError(f"the default configuration failed: {default[FAILURE]}")
        reference = {name: spec.reference_factor * default[name] for name in OBJECTIVES}
        history = run_study(grid, spec.sampler, spec.seed, spec.trials, reference)
        return {
            "hypervolume_half": history[spec.trials // 2 - 1],
            "hypervolume": history[-1],
            "hypervolume_over_trials": history,
            "measured_points": grid.measured,
            "grid_points": grid.size,
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per sampler."""
        note = (
            f"Hypervolume after {self.trials // 2} and {self.trials} trials; means over the seeds "
            f"with 95 % bootstrap intervals, compared with {self.samplers[0]} at equal seeds."
        )
        half = Column("hypervolume_half", "hypervolume", f"hypervolume after {self.trials // 2}")
        end = Column("hypervolume", heading=f"after {self.trials}")
        return [make_table(("sampler", half, end, "gain", "wins", "seeds"), summarise(rows),
                           note=note)]  # fmt: skip

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Hypervolume over trials, a line per sampler."""
        series = []
        for name, studies in _by_sampler(rows).items():
            values = np.array([result["hypervolume_over_trials"] for result in studies.values()])
            mean, count = values.mean(axis=0), len(values)
            spread = values.std(axis=0, ddof=1) if count > 1 else np.zeros_like(mean)
            half = 1.96 * spread / np.sqrt(count)
            trials = list(range(1, values.shape[1] + 1))
            low, high = (mean - half).tolist(), (mean + half).tolist()
            series.append(Series(name, trials, mean.tolist(), low, high, "lines"))
        caption = "Line: mean over the seeds; band: its 95 % interval."
        panel = Panel("trials", "hypervolume", series)
        return [Chart("hypervolume", "Hypervolume over trials", caption, [panel])]


def run_study(
    grid: Grid, sampler: str, seed: int, trials: int, reference: Mapping[str, float]
) -> list[float]:
    """Explore in memory; return the hypervolume after every trial, as a share of the box."""
    trials_made = explore_in_memory(grid.space, grid, OBJECTIVES, sampler, seed, trials, reference)
    kept: list[list[float]] = []
    history = []
    for _, measured in trials_made:
        if not measured.get(FAILURE):
            values = objective_values(measured, OBJECTIVES, reference)
            kept.append([v / reference[n] for v, n in zip(values, OBJECTIVES, strict=True)])
        history.append(hypervolume(kept, [1.0] * len(OBJECTIVES)))
    return history


def summarise(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """A line per sampler: hypervolume, and by how much it exceeds that of the first.

    Intervals are 95 % bootstrap intervals of the mean over seeds; differences pair equal seeds.
    """
    samplers = _by_sampler(rows)
    first = next(iter(samplers.values()), {})
    lines = []
    for name, studies in samplers.items():
        results = list(studies.values())
        line: dict[str, Any] = {"sampler": name, "seeds": len(results)}
        for key in ("hypervolume_half", "hypervolume"):
            line[key] = _mean_interval([result[key] for result in results])
        if studies is not first:
            gains = [
                result["hypervolume"] - first[seed]["hypervolume"]
                for seed, result in studies.items()
                if seed in first
            ]
            line["gain"] = _mean_interval(gains)
            line["wins"] = sum(gain > 0 for gain in gains)
        lines.append(line)
    return lines


def _by_sampler(rows: Sequence[Row]) -> dict[str, dict[int, Row]]:
    """Results by sampler and seed."""
    samplers: dict[str, dict[int, Row]] = {}
    for row in finished(rows):
        samplers.setdefault(row["spec"]["sampler"], {})[row["spec"]["seed"]] = row["result"]
    return samplers


def _mean_interval(values: Sequence[float]) -> Interval:
    return bootstrap_interval((values,), lambda x, axis: np.asarray(np.mean(x, axis=axis)))
