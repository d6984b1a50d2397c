"""Curricula: stages of a training, from easy to the full problem, with random light and noise.

    - {until: 0.2, scenes: [table], step_m: 0.06, step_deg: 6, episode_steps: 50}
    - {until: 0.6, above: 20, noise: [0.5, 1.5]}
    - {perturbations: {illumination: {dim: [0, 0.6], lamp: [0, 1]}}}

Pass such a file as ``--curriculum`` to a trainer. The start of an episode is drawn in every stage,
as always. Validation always uses the full problem.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from ms_slam_env._runtime.input_files import read_text
from ms_slam_env.config import Checked, bounded, from_dict, load_yaml
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.perturbations import make_perturbation

P = TypeVar("P")
Range = tuple[float, float]
Between = Callable[[float, float], float]
"""Draws a number between two, like ``rng.uniform``."""

_STREAM = 2  # of an episode's seed; the environment draws from the seed itself


@dataclass(frozen=True)
class Stage(Checked):
    """A stage of a training; options that it does not set are the problem's.

    Attributes:
        until: share of the training's steps at which the stage ends; None: at the end of training,
            or by ``above``.
        above: return on the validation episodes at which the stage ends earlier.
        scenes: as the trainers' option.
        scene_seeds: as the trainers' option.
        episode_steps: as the trainers' option.
        step_m: as the trainers' option.
        step_deg: as the trainers' option.
        frames_per_action: as the trainers' option.
        noise: range of the strength of the sensor noise, drawn for each episode.
        perturbations: name to options; a pair of numbers is a range, drawn from for each episode.
    """

    until: float | None = bounded(None, 0, 1)
    above: float | None = bounded(None, -1e9, 1e9)
    scenes: tuple[str, ...] | None = None
    scene_seeds: int | None = bounded(None, 1, 100_000)
    episode_steps: int | None = bounded(None, 1, 100_000)
    step_m: float | None = bounded(None, 0, 1)
    step_deg: float | None = bounded(None, 0, 90)
    frames_per_action: int | None = bounded(None, 1, 1000)
    noise: Range | None = None
    perturbations: dict[str, dict[str, Any]] = field(default_factory=dict)

    def problem(self, args: P) -> P:
        """A trainer's options in this stage."""
        own = ("scenes", "scene_seeds", "episode_steps", "step_m", "step_deg", "frames_per_action")
        given = {name: getattr(self, name) for name in own}
        return replace(args, **{n: v for n, v in given.items() if v is not None})  # type: ignore

    def is_over(self, share: float, score: float) -> bool:
        """Whether the stage has ended, given the share of steps and the validation return."""
        by_share = self.until is not None and share >= self.until
        return by_share or (self.above is not None and score > self.above)

    def draw(self, between: Between) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
        """Draw the options of ``gym.make`` and the perturbations of an episode."""
        noise = {} if self.noise is None else {"noise": {"name": "kinect", "strength": self.noise}}
        drawn = _drawn({"options": noise, "perturbations": self.perturbations}, between)
        return drawn["options"], list(drawn["perturbations"].items())


def _drawn(value: Any, between: Between) -> Any:
    """Replace each pair of numbers in ``value`` by a number drawn between them."""
    if isinstance(value, Mapping):
        return {name: _drawn(part, between) for name, part in value.items()}
    is_range = isinstance(value, (tuple, list)) and len(value) == 2
    return float(between(*value)) if is_range else value


def read_curriculum(path: Path) -> tuple[Stage, ...]:
    """Read the stages from a file.

    Raises:
        InputError: no such file, or one that is not a curriculum.
    """
    try:
        content = load_yaml(read_text(path, "curriculum"))
        if not isinstance(content, list) or not content:
            raise InputError("a list of stages is wanted")
        stages = tuple(_stage(one, f"stage {k}") for k, one in enumerate(content, 1))
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: {error}") from None
    for k, stage in enumerate(stages[:-1], 1):
        if stage.until is None and stage.above is None:
            raise InputError(f"{path}: stage {k} has neither until nor above: it never ends")
    shares = [stage.until for stage in stages if stage.until is not None]
    if shares != sorted(shares):
        raise InputError(f"{path}: stages end at {shares}, one before the one before it")
    return stages


def _stage(content: Any, name: str) -> Stage:
    known = {one.name for one in fields(Stage)}
    if not isinstance(content, Mapping) or not content.keys() <= known:
        raise InputError(f"{name}: {content!r} must be a mapping of {', '.join(sorted(known))}")
    lists = ("scenes", "noise")
    made = from_dict(Stage, {k: tuple(v) if k in lists else v for k, v in content.items()}, name)
    if made.noise is not None and not (
        len(made.noise) == 2 and 0 <= made.noise[0] <= made.noise[1]
    ):
        raise InputError(f"{name}: noise = {list(made.noise)} must be two numbers, the lower first")
    for end in (min, max):
        _, perturbations = made.draw(end)
        for perturbation, options in perturbations:
            make_perturbation(perturbation, options)
    return made


def stage_now(
    stages: Sequence[Stage], steps: int, points: Sequence[Mapping[str, Any]], total: int
) -> int:
    """The stage after ``steps`` of ``total``, given the validations; the same for a resumed run.

    A validation ends at most one stage; the one before training ends none.
    """
    stage = 0
    scores = [(p["timesteps"], p["return"]) for p in points if 0 < p["timesteps"] <= steps]
    for done, score in [*scores, (steps, -np.inf)]:
        while stage < len(stages) - 1 and stages[stage].is_over(done / total, -np.inf):
            stage += 1
        stage += stage < len(stages) - 1 and stages[stage].is_over(0.0, score)
    return stage


class Staged(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that is rebuilt for an episode of another stage, or with other draws.

    Args:
        stages: stages of the training.
        args: options of the training.
        make: makes an environment from a problem and further options of ``gym.make``.
    """

    def __init__(self, stages: Sequence[Stage], args: Any, make: Any) -> None:
        self.stages, self.args, self._make = stages, args, make
        self.stage = 0
        self._made: tuple[Any, ...] = ()
        super().__init__(make(args, {}))
        self._spaces = self.env.observation_space, self.env.action_space
        self._rng = np.random.default_rng(args.seed)

    def enter_stage(self, stage: int) -> None:
        """Switch to another stage at the next reset."""
        self.stage = stage

    def check(self) -> None:
        """Make the environment of every stage.

        Raises:
            InputError: a stage whose environment cannot be made, or differs in observations or
                actions.
        """
        for stage, one in enumerate(self.stages):
            self.stage = stage
            self._enter(*one.draw(self._rng.uniform))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode of the current stage."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, _STREAM])
        drawn = self.stages[self.stage].draw(self._rng.uniform)
        if (self.stage, *drawn) != self._made:
            self._enter(*drawn)
            seed = int(self._rng.integers(2**31)) if seed is None else seed
        return self.env.reset(seed=seed, options=options)

    def _enter(self, options: dict[str, Any], perturbations: list[tuple[str, Any]]) -> None:
        self.env.close()
        self.env = self._make(self.stages[self.stage].problem(self.args), options)
        if (self.env.observation_space, self.env.action_space) != self._spaces:
            raise InputError(f"stage {self.stage + 1} has other observations or actions")
        for name, strength in perturbations:
            self.env.unwrapped.perturb(make_perturbation(name, strength))  # type: ignore
        self._made = (self.stage, options, perturbations)
