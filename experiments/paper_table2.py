"""Experiment (b): Table II of Saeedi et al., ICRA 2017."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

from ms_slam_env.benchmark.episodes import (
    DOTS,
    EpisodeSpec,
    SteppedExperiment,
    make_env,
    short_planner_names,
)
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, by_group
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import relative_cut
from ms_slam_env.report.tables import Column, Grouping, Table, complete_cases, grouped, make_table
from ms_slam_env.robot import FixedTranslation

if TYPE_CHECKING:
    from ms_slam_env.env import ActiveSlamEnv

MOTIONS = {
    "MSActiveSLAM-FreeCamera-v0": "free motion",
    "MSActiveSLAM-FixedTranslation-v0": "fixed translation",  # with steps that fit on one line
}
"""Environments of the table's two experiments to their names in the table."""
PAPER_CUTS = {
    "MSActiveSLAM-FreeCamera-v0": {"ate_m": 1 - 0.1549 / 0.2343, "rer_m": 1 - 0.0518 / 0.0773},
    "MSActiveSLAM-FixedTranslation-v0": {
        "ate_m": 1 - 0.0582 / 0.0854,
        "rer_m": 1 - 0.0726 / 0.0809,
    },
}
"""How much active SLAM cuts the errors of random walk in the paper's table, as shares."""
METRICS = (
    *("ate_m", "ate_tracked_m", "tracked_share", "rer_m", "rcm", "path_length_m"),
    *("rcm_tracked", "lost"),
)
STRAIGHT = "MSActiveSLAM-FixedTranslation-v0"
STEP_SIZES_M = (0.12, 0.10, 0.08, 0.06, 0.05, 0.04, 0.03, 0.025, 0.02, 0.015, 0.01)
"""Steps tried on a straight line; the largest with which the whole path fits is taken."""
_CUTS = ("ate_cut", "ate_cut_paper", "rer_cut", "rer_cut_paper")


@dataclass(frozen=True)
class PaperTable2(SteppedExperiment):
    """Table II of the paper: an active planner against random walk

    Compares errors of trajectory and map, with free motion and with a fixed translation.
    """

    active: str = "greedy"
    """The active planner, options appended as in greedy,rho_I=0.3."""
    baseline: str = "random"
    """Planner to compare it with."""
    scenes: tuple[str, ...] = ("living_room",)
    """Names of scenes, or mesh files; the paper has one living room."""
    episodes: int = 20
    steps: int = 100
    seeds: str = "test"

    @property
    def planners(self) -> Sequence[str]:
        """Both planners."""
        return self.baseline, self.active

    def compared(self) -> Sequence[Mapping[str, Any]]:
        """Both planners with each kind of motion."""
        return [{"env_id": env_id, "planner": name} for env_id in MOTIONS for name in self.planners]

    def specs(self) -> list[EpisodeSpec]:
        """Every episode; on a straight line with steps so small that the line need not reverse.

        Raises:
            InputError: no step is small enough.
        """
        return [
            replace(spec, step_m=step_on_a_line(replace(spec, planner="stationary")))
            if spec.env_id == STRAIGHT
            else spec
            for spec in super().specs()
        ]

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians by experiment and planner, and the cuts of the errors beside the paper's cuts."""
        order = list(MOTIONS)
        pairs = sorted(
            paired(rows),
            key=lambda row: (
                order.index(row["spec"]["env_id"]),
                row["spec"]["planner"] == self.active,
            ),
        )
        label = {"env_id": MOTIONS.__getitem__}
        note = (
            "Medians (of losses: the share) with 95 % intervals, over the episodes that both "
            "planners finished."
        )
        medians = Grouping(("env_id", "planner"), METRICS, label, count="episodes")
        columns = [Column(name, name.removesuffix("_paper"), _paper_heading(name))
                   for name in _CUTS]  # fmt: skip
        cuts = [self._cuts(pairs, env_id) for env_id in MOTIONS]
        return [
            medians.table(pairs, note=note),
            make_table(["env_id", *columns], cuts, f"Cut of the errors by {self.active}"),
        ]

    def _cuts(self, pairs: Sequence[Row], env_id: str) -> dict[str, Any]:
        results = grouped(pairs, ("env_id", "planner"))
        line: dict[str, Any] = {"env_id": MOTIONS[env_id]}
        for key, paper in PAPER_CUTS[env_id].items():
            values, others = (
                [result[key] for result in results.get((env_id, planner), [])]
                for planner in (self.active, self.baseline)
            )
            name = key.replace("_m", "_cut")
            line |= {name: relative_cut(values, others), f"{name}_paper": paper}
        return line

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Errors of every episode, by experiment and planner."""
        label = short_planner_names((self.baseline, self.active)).__getitem__
        panels = [
            replace(panel, title=name)
            for env_id, name in MOTIONS.items()
            for panel in by_group(
                [row for row in rows if row["spec"]["env_id"] == env_id],
                "planner",
                ("ate_m", "rer_m"),
                ("ate_m",),
                label=label,
            )
        ]
        return [Chart("paper_table2", "Errors of trajectory and map", DOTS, panels)]


_steps: dict[str, float] = {}  # of episodes that were looked at


def step_on_a_line(spec: EpisodeSpec) -> float:
    """Largest step, at most the given one, with which all steps of an episode lie on one line.

    With steps of 12 cm a line through a room is at an end after 20 to 40 steps and would be gone
    back and forth, over places that are mapped.

    Raises:
        InputError: no step is small enough.
    """
    sizes = [size for size in STEP_SIZES_M if size <= spec.step_m]
    if str(spec) not in _steps:
        for size in sizes:
            env = make_env(replace(spec, step_m=size))
            try:
                env.reset(seed=spec.seed)
                line = cast("ActiveSlamEnv", env.unwrapped).embodiment
                assert isinstance(line, FixedTranslation)
                if line.steps_ahead(spec.steps) >= spec.steps:
                    _steps[str(spec)] = size
                    break
            finally:
                env.close()
        else:
            raise InputError(
                f"scene {spec.scene}, seed {spec.seed}: no straight line of {spec.steps} steps of "
                f"{100 * (sizes or STEP_SIZES_M)[-1]:g} cm from the start"
            )
    return _steps[str(spec)]


def _paper_heading(name: str) -> str:
    return "in the paper" if name.endswith("_paper") else ""


def paired(rows: Sequence[Row]) -> list[Row]:
    """Rows of the episodes that both planners finished.

    ``rcm_tracked`` is the completeness if tracking was never lost, otherwise None.
    """
    pairs = complete_cases(rows, ("env_id", "scene", "seed"), "planner")
    return [
        {**row, "result": {**r, "rcm_tracked": None if r["lost"] else r["rcm"]}}
        for row in pairs
        for r in (row["result"],)
    ]
