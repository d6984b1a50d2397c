"""Run an exploration, from its settings to its results on disk."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ms_slam_env._runtime.progress import Bar
from ms_slam_env._runtime.result_folders import alone_in
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.cost import energy_counters
from ms_slam_env.report.results import Results, write_result_folder
from ms_slam_env.sequences import check_sequence
from ms_slam_env.slam.configuration import SlamConfiguration, write_configuration, write_levels
from ms_slam_env.tuning.choices import Limit, as_options, choose, for_divergence, levels_of
from ms_slam_env.tuning.evaluator import SlamEvaluator
from ms_slam_env.tuning.explorer import explore
from ms_slam_env.tuning.front import Point, hypervolume_history, importances, points_of
from ms_slam_env.tuning.held_out import DEFAULT, compare_configurations
from ms_slam_env.tuning.results import ABOUT, TITLE, Explored
from ms_slam_env.tuning.settings import ExplorationSettings
from ms_slam_env.tuning.space import SearchSpace, absences, make_space
from ms_slam_env.tuning.study_storage import StudyStorage

FOR_DIVERGENCE = "for-divergence"


@dataclass(frozen=True)
class Exploration(Checked):
    """Parameters, evaluation and settings of an exploration.

    Attributes:
        evaluator: measures a configuration.
        settings: objectives, constraints and sampler.
        parameters: ``NAME``, ``NAME=low:high[:log]``, ``NAME=a,b,c``, or a group of them.
        base: configuration of the first trial, from which the exploration starts.
        held_out: sequences for testing the front and the chosen configurations.
        for_divergence: (M_I, M_D) for which to choose one more configuration; None for none.
        tolerance: largest error of that configuration and of levels of adaptation, as a multiple
            of the default's.

    Raises:
        InputError: an unknown name, a value out of range, a sequence that cannot be opened, or an
            objective that this machine or evaluation cannot measure.
    """

    evaluator: SlamEvaluator
    settings: ExplorationSettings = field(default_factory=ExplorationSettings)
    parameters: tuple[str, ...] = ("algorithm",)
    base: SlamConfiguration = field(default_factory=SlamConfiguration)
    held_out: tuple[str, ...] = ()
    for_divergence: tuple[float, float] | None = None
    tolerance: float = bounded(1.2, 1.0, 1000.0)

    def __post_init__(self) -> None:
        """Refuse settings that cannot be measured, before a study stores them."""
        super().__post_init__()
        for text in (*self.evaluator.sequences, *self.held_out):
            check_sequence(text)
        asked = {*self.settings.objectives}
        asked |= {constraint.metric for constraint in self.settings.parsed_constraints()}
        if "map_error_mm" in asked and not self.evaluator.map_error:
            raise InputError("map_error_mm is not measured: the evaluator has map_error off")
        if "ate_worst_ratio" in asked and self.evaluator.baseline is None:
            raise InputError("ate_worst_ratio is not measured: the evaluator has no baseline")
        reason = energy_counters()["cpu"].reason
        if "energy_j" in asked and reason:
            raise InputError(
                f"energy_j is not available: {reason}; energy_model_j is what a stated model says"
            )
        if "energy_model_j" in asked and not reason:
            raise InputError(
                "energy_model_j is only for machines without energy counters; use energy_j"
            )
        both = set(self.held_out) & set(self.evaluator.sequences)
        if both:
            raise InputError(f"sequence {sorted(both)[0]} is explored and held out")


def run_exploration(
    exploration: Exploration,
    out: Path,
    trials: int,
    workers: int = 1,
    ray_address: str | None = None,
) -> Results:
    """Explore until ``trials`` trials have finished, and write the results to ``out``.

    Files: ``study.db`` (Optuna's, to resume from), ``explore.json``, ``table.md``, ``pareto.png``
    and other figures, the chosen configurations as YAML, and ``levels.yaml`` with options of
    run-time adaptation and frame selection (``choices.as_options``).

    Raises:
        InputError: bad input, ``out`` holds another exploration, another process works in it, or,
            after everything is written, no trial was measured at the requested divergence.
        RuntimeError: worker processes die repeatedly.
    """
    space = make_space(exploration.parameters, exploration.base)
    with alone_in(out):
        storage = _explored(exploration, space, out, trials, workers, ray_address)
        return write_exploration(exploration, storage, out)


def _explored(
    exploration: Exploration,
    space: SearchSpace,
    out: Path,
    trials: int,
    workers: int,
    ray_address: str | None,
) -> StudyStorage:
    """Continue the study until ``trials`` trials have finished, and show progress."""
    with Bar(total=trials, desc=exploration.settings.sampler, unit="trial") as bar:
        return explore(
            out,
            space,
            exploration.settings,
            exploration.evaluator,
            trials,
            workers,
            ray_address,
            lambda finished: _show(bar, finished),
        )


def _show(bar: Bar, finished: int) -> None:
    bar.update(finished - bar.n)


def write_exploration(exploration: Exploration, storage: StudyStorage, out: Path) -> Results:
    """Write all files except the study."""
    objectives = exploration.settings.objectives
    points = points_of(storage)
    reference = storage.reference() or {}
    chosen = choose(points, objectives)
    limit = Limit.of(points, objectives, exploration.tolerance)
    answer = _answer(exploration, points, limit)
    levels = levels_of(points, limit)
    size = exploration.evaluator.image_size
    made = {name: _configuration(storage, point, name, size) for name, point in chosen.items()}
    # A level describes its parameters at a divergence between frames that are all processed.
    made_levels = [
        replace(_configuration(storage, point, "level", size), keep_every=1) for point in levels
    ]
    options = as_options(levels, made_levels, points)
    files = {name: f"{name.replace('_', '-')}.yaml" for name in chosen}

    def write_chosen(folder: Path) -> None:
        for name, configuration in made.items():
            write_configuration(folder / files[name], configuration)
        if isinstance(answer, Point):
            own = replace(_configuration(storage, answer, FOR_DIVERGENCE, size), keep_every=1)
            write_configuration(folder / f"{FOR_DIVERGENCE}.yaml", own)
        if options:
            write_levels(folder / "levels.yaml", options)

    named = chosen | ({FOR_DIVERGENCE: answer} if isinstance(answer, Point) else {})
    explored = Explored(
        objectives,
        exploration.evaluator.clock,
        list(storage.space.parameters),
        points,
        named,
        reference,
        hypervolume_history(points, reference, objectives).tolist(),
        importances(storage),
        *_compared(exploration, storage, points, chosen, out),
        absences(exploration.parameters, exploration.base),
        [point.number for point in levels] if "adaptation" in options else [],
    )
    results = write_result_folder(
        out,
        "explore.json",
        write_chosen,
        kind="exploration",
        title=TITLE,
        about=ABOUT,
        tables=explored.tables(),
        charts=explored.charts(),
        rows=explored.rows(),
        rows_key="trials",
        content={
            "config": {
                **asdict(exploration.evaluator),
                **asdict(exploration.settings),
                "parameters": {name: str(kind) for name, kind in storage.space.parameters.items()},
                "base": asdict(exploration.base),
                "held_out": exploration.held_out,
            },
            "objectives": objectives,
            "reference": reference,
            "chosen": {
                name: {"file": files[name], "trial": point.number, "params": point.params}
                for name, point in chosen.items()
            },
            "levels": explored.levels,
            "for_divergence": answer.number if isinstance(answer, Point) else None,
            "hypervolume": explored.hypervolume,
            "importance": explored.importance,
        },
    )
    if isinstance(answer, InputError):
        raise answer
    return results


def _answer(
    exploration: Exploration, points: list[Point], limit: Limit
) -> Point | InputError | None:
    """The configuration for the requested divergence, or the error that says why there is none."""
    if exploration.for_divergence is None:
        return None
    try:
        return for_divergence(points, *exploration.for_divergence, limit)
    except InputError as error:
        return error  # raised once the measurements are on disk


def _compared(
    exploration: Exploration,
    storage: StudyStorage,
    points: list[Point],
    chosen: dict[str, Point],
    out: Path,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Compare the default, the chosen configurations and the front on held-out sequences.

    Also measures the default and the chosen ones again on the explored sequences.
    """
    known = {point.number for point in chosen.values()}
    others = {f"trial {p.number}": p for p in points if p.on_front and p.number not in known}

    def compared(of: dict[str, Point], sequences: tuple[str, ...], file: str) -> Any:
        made = {name: storage.space.configuration(point.params) for name, point in of.items()}
        made = {DEFAULT: storage.space.base, **made}
        return compare_configurations(exploration.evaluator, made, sequences, out / file)

    return (
        compared(chosen | others, exploration.held_out, "held_out.jsonl"),
        compared(chosen, exploration.evaluator.sequences, "again.jsonl"),
    )


def _configuration(
    storage: StudyStorage, point: Point, purpose: str, image_size: str
) -> SlamConfiguration:
    """The configuration of ``point``, with its origin and the image size it ran at."""
    made = storage.space.configuration(point.params)
    about = {
        "purpose": purpose,
        "trial": point.number,
        "measured": {k: v for k, v in point.measured.items() if v is not None},
    }
    return replace(made, image_size=made.image_size or image_size, about=about)
