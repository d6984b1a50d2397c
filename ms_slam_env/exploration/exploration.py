"""An exploration from its settings to its results on disk."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ms_slam_env.errors import InputError
from ms_slam_env.exploration.evaluator import SlamEvaluator
from ms_slam_env.exploration.explorer import explore
from ms_slam_env.exploration.front import (
    Point,
    choose,
    hypervolume_history,
    importances,
    points_of,
)
from ms_slam_env.exploration.held_out import DEFAULT, compare_configurations
from ms_slam_env.exploration.results import ABOUT, TITLE, Explored
from ms_slam_env.exploration.settings import ExplorationSettings
from ms_slam_env.exploration.space import make_space
from ms_slam_env.exploration.study_storage import StudyStorage
from ms_slam_env.metrics.cost import energy_counters
from ms_slam_env.report.results import Results, write_result_folder
from ms_slam_env.sequences import check_sequence
from ms_slam_env.slam.configuration import SlamConfiguration, write_configuration


@dataclass(frozen=True)
class Exploration:
    """What is explored, on what, and how.

    Attributes:
        evaluator: measures a configuration.
        settings: objectives, constraints and sampler.
        parameters: ``NAME``, ``NAME=low:high[:log]``, ``NAME=a,b,c``, or a group of them.
        base: configuration that the exploration starts from, its first trial.
        held_out: sequences that the front and the chosen configurations are judged on.

    Raises:
        InputError: an unknown name, a value out of range, a sequence that cannot be had, or an
            objective that this machine or evaluation cannot measure.
    """

    evaluator: SlamEvaluator
    settings: ExplorationSettings = field(default_factory=ExplorationSettings)
    parameters: tuple[str, ...] = ("algorithm",)
    base: SlamConfiguration = field(default_factory=SlamConfiguration)
    held_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what cannot be measured before a study is begun that would keep it."""
        for text in (*self.evaluator.sequences, *self.held_out):
            check_sequence(text)
        asked = {*self.settings.objectives}
        asked |= {constraint.metric for constraint in self.settings.parsed_constraints()}
        if "map_error_mm" in asked and not self.evaluator.map_error:
            raise InputError("map_error_mm is not measured: the evaluator has map_error off")
        if "energy_j" in asked:
            reasons = [counter.reason for counter in energy_counters("cpu").values()]
            if all(reasons):
                raise InputError(f"energy_j is not available: {'; '.join(reasons)}")
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
    """Explore until ``trials`` trials have finished, and write what came of it to ``out``.

    ``study.db`` (Optuna's, to go on from), ``explore.json``, ``table.md``, ``pareto.png`` and
    other figures, and the chosen configurations as YAML.

    Raises:
        InputError: bad input, or ``out`` holds another exploration.
        RuntimeError: worker processes die again and again.
    """
    space = make_space(exploration.parameters, exploration.base)
    with tqdm(total=trials, desc=exploration.settings.sampler, unit="trial") as bar:
        storage = explore(
            out,
            space,
            exploration.settings,
            exploration.evaluator,
            trials,
            workers,
            ray_address,
            lambda finished: _show(bar, finished),
        )
    return write_exploration(exploration, storage, out)


def _show(bar: tqdm, finished: int) -> None:
    bar.update(finished - bar.n)


def write_exploration(exploration: Exploration, storage: StudyStorage, out: Path) -> Results:
    """Write everything but the study."""
    objectives = exploration.settings.objectives
    points = points_of(storage)
    reference = storage.reference() or {}
    chosen = choose(points, objectives)
    files = {name: f"{name.replace('_', '-')}.yaml" for name in chosen}

    def write_chosen(folder: Path) -> None:
        for name, point in chosen.items():
            made = _configuration(storage, point, name, exploration.evaluator.image_size)
            write_configuration(folder / files[name], made)

    explored = Explored(
        objectives,
        exploration.evaluator.clock,
        list(storage.space.parameters),
        points,
        chosen,
        reference,
        hypervolume_history(points, reference, objectives).tolist(),
        importances(storage),
        *_compared(exploration, storage, points, chosen, out),
    )
    return write_result_folder(
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
            "hypervolume": explored.hypervolume,
            "importance": explored.importance,
        },
    )


def _compared(
    exploration: Exploration,
    storage: StudyStorage,
    points: list[Point],
    chosen: dict[str, Point],
    out: Path,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The default, the chosen and the rest of the front on held-out sequences.

    Then default and chosen, measured again on the explored ones.
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
    """The configuration of ``point`` with where it comes from and the image size it ran at."""
    made = storage.space.configuration(point.params)
    about = {
        "purpose": purpose,
        "trial": point.number,
        "measured": {k: v for k, v in point.measured.items() if v is not None},
    }
    return replace(made, image_size=made.image_size or image_size, about=about)
