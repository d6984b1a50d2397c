"""What experiments have in common whose rows are episodes of planners."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from ms_slam_env.benchmark.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    EpisodeSpec,
    check_episodes,
    check_names,
    parse_options,
    run_episode,
    seed_list,
)
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.report.records import Row

DOTS = "Small dots: episodes. Large mark and bar: median and its 95 % interval."
"""Caption of charts by `report.charts.by_group`."""


def episode_specs(
    given: Mapping[str, Any],
    scenes: Sequence[str],
    seeds: Sequence[int],
    compared: Sequence[Mapping[str, Any]],
) -> list[EpisodeSpec]:
    """Scenes x seeds x what is compared; ``given`` says the fields that all have.

    Raises:
        InputError: a value out of range, or an unknown option.
    """
    known = {field.name for field in fields(EpisodeSpec)}
    shared = {name: value for name, value in given.items() if name in known}
    shared["options"] = parse_options(given["options"])
    return [
        EpisodeSpec(**{**shared, "scene": scene, "seed": seed, **different})
        for scene in scenes
        for seed in seeds
        for different in compared
    ]


@dataclass(frozen=True)
class EpisodeExperiment(Experiment):
    """Scenes x seeds x what is compared, every episode of a seed from the same start pose.

    Options that are named as a field of `EpisodeSpec` are that field of every episode.
    """

    scenes: tuple[str, ...]
    """Names of scenes, or mesh files."""
    episodes: int
    """Seeds for each scene."""
    steps: int
    """Length of an episode."""
    seeds: str
    """Split that the seeds come from: train, validation or test; or your own, as 7000-7003."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in lookahead.reference=live targets.M_I=0.05."""

    unit = rows_key = "episodes"
    run = staticmethod(run_episode)

    @property
    @abstractmethod
    def planners(self) -> Sequence[str]:
        """Planners that play; a field where the user names them."""

    def compared(self) -> Sequence[Mapping[str, Any]]:
        """What differs between the episodes of a scene and seed, as fields of `EpisodeSpec`."""
        return [{"planner": planner} for planner in self.planners]

    def specs(self) -> list[EpisodeSpec]:
        """Every episode; those of one scene and seed are neighbours and share its geometry."""
        check_names(self.planners, self.scenes)
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        seeds = seed_list(self.seeds, self.episodes)
        return episode_specs(own, self.scenes, seeds, self.compared())

    def prepare(self) -> None:
        """Start one episode of each planner."""
        check_episodes(self.specs())

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """The seeds."""
        return {"seeds": seed_list(self.seeds, self.episodes)}


@dataclass(frozen=True)
class SteppedExperiment(EpisodeExperiment):
    """Episodes with steps of one size."""

    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
