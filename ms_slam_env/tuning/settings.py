"""Settings of an exploration, which are stored with the study and must not change on resuming."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning.objectives import METRICS, Constraint, Measured, parse_constraint
from ms_slam_env.tuning.samplers import SAMPLERS
from ms_slam_env.tuning.space import SearchSpace

Evaluate = Callable[[SlamConfiguration], Measured]
"""Measures a configuration: returns values of ``METRICS`` by name, ``M_I`` and ``M_D``, and a text
``failure`` if SLAM failed. It is called in other processes, so it must be picklable. An exception
stops the exploration; a failure of SLAM is returned instead."""


@dataclass(frozen=True)
class ExplorationSettings(Checked):
    """Settings that determine the trials of a study.

    Attributes:
        objectives: names in ``METRICS``, two or more.
        constraints: texts such as ``ate_m<0.01``.
        sampler: random, nsga2, tpe, gp or forest.
        seed: seed of the sampler.
        population: population size of NSGA-II.
        reference_factor: values are capped at this multiple of the default's, which is also the
            reference point for the volume that the front dominates.
        reference: cap of each objective, instead of that multiple.
        context: everything else that determines the measurements, such as the sequences.

    Raises:
        InputError: an unknown name, or a value out of range.
    """

    objectives: tuple[str, ...] = ("ate_m", "ext_ms")
    constraints: tuple[str, ...] = ()
    sampler: str = chosen("tpe", *SAMPLERS)
    seed: int = bounded(0, 0, 2**31)
    population: int = bounded(16, 2, 10_000)
    reference_factor: float = bounded(3.0, 1.01, 1000.0)  # so that the default lies inside
    reference: dict[str, float] = field(default_factory=dict)
    context: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse settings that no study could use."""
        super().__post_init__()
        for name in self.objectives:
            if name not in METRICS:
                raise unknown("objective", name, METRICS)
        if len(set(self.objectives)) < max(2, len(self.objectives)):
            raise InputError(f"objectives {list(self.objectives)} must be two or more, each once")
        if self.reference and set(self.reference) != set(self.objectives):
            raise InputError(f"reference {self.reference} must name every objective")
        self.parsed_constraints()

    def parsed_constraints(self) -> list[Constraint]:
        """The constraints."""
        return [parse_constraint(text) for text in self.constraints]

    def fingerprint(self, space: SearchSpace) -> dict[str, Any]:
        """Everything that must not change when the study resumes, as text."""
        content = {
            **asdict(self),
            "parameters": {name: str(kind) for name, kind in space.parameters.items()},
            "base": {name: v for name, v in asdict(space.base).items() if name != "about"},
        }
        return {name: _text(value) for name, value in content.items()}


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_text(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_text, value)) + "]"
    return str(value)
