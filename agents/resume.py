"""Resume a run: which options its file may set, and which must not change.

A run may come from an untrusted source. Its file may set numbers and names of installed parts; a
module, file or address that it names is only used if the command line names it again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
from ms_slam_agents.options import P, Problem, named_in, of_task, of_types, shipped_tasks

from ms_slam_env._runtime.command_line import parse
from ms_slam_env.config import from_dict, parse_named
from ms_slam_env.env.planners import PLANNERS
from ms_slam_env.env.registry import POINT as OBSERVATIONS
from ms_slam_env.env.reward import DEFAULT, RewardConfig
from ms_slam_env.errors import InputError
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import RESULTS
from ms_slam_env.scenes.registry import POINT as SCENES

KEPT = (
    "task",
    "env_id",
    "embodiment",
    "observation",
    "step_m",
    "step_deg",
    "reward",
    "without",
    "through",
    "hidden",
)
"""Options that a run keeps when it is resumed: another network, or another problem."""

JUDGED_WITH = (
    "eval_episodes",
    "deterministic_eval",
    "scenes",
    "scene_seeds",
    "episode_steps",
    "frames_per_action",
    "image_size",
)
"""Options that the points of a learning curve have in common."""

# -- What a file may say -----------------------------------------------------------------------


def _one_of(names: Callable[[], Collection[str]]) -> Callable[[str], bool]:
    return lambda text: text in names()


def _is_planner(text: str) -> bool:
    """Whether a text names an installed planner, with numbers as options if any."""
    name, options = parse_named(text, "planner")
    return name in PLANNERS.names() and not any(
        isinstance(value, (str, list, dict)) for value in options.values()
    )


def _algorithms() -> Collection[str]:
    from ms_slam_agents.policy_file import ALGORITHMS  # here: builds no arm for a new run

    return ALGORITHMS


def _embodiments() -> Collection[str]:
    from ms_slam_env.env.embodiments import EMBODIMENTS

    return EMBODIMENTS


_NAMES: dict[str, Callable[[str], bool]] = {
    "algorithm": _one_of(_algorithms),
    "also": _one_of(shipped_tasks),
    "embodiment": _one_of(_embodiments),
    "env_id": _one_of(lambda: gym.registry),
    "image_size": lambda text: re.fullmatch("[0-9]+x[0-9]+", text) is not None,
    "observation": _one_of(OBSERVATIONS.names),
    "reward": _one_of(lambda: [DEFAULT, *RewardConfig.named()]),
    "scenes": _one_of(SCENES.names),
    "task": _one_of(shipped_tasks),
    "teacher": _is_planner,
    "through": _is_planner,
    "without": _one_of(lambda: [term.name for term in fields(RewardConfig)]),
}
"""Text options that a file may set, each with a check of the text; others it may not set."""


def _may_say(name: str, value: Any) -> bool:
    """Whether a file may say option ``name``, as JSON has its ``value``."""
    parts = value if isinstance(value, list) else [value]
    known = _NAMES.get(name)
    return all(
        part is None
        or isinstance(part, (bool, int, float))
        or (isinstance(part, str) and known is not None and known(part))
        for part in parts
    )


# -- The options of a run that goes on ---------------------------------------------------------


def parse_options(
    cls: type[P], arguments: Sequence[str], prog: str, trainer: str, algorithms: Sequence[str]
) -> P:
    """Parse options ``cls`` from a command line; a resumed run keeps those not given.

    Args:
        cls: the options of the trainer.
        arguments: the command line.
        prog: its name.
        trainer: whose options a task's file has.
        algorithms: that the file of a run of this trainer is of.

    Raises:
        InputError: bad options, nothing to resume from, or a file that says what no file may.
    """
    said = named_in(arguments)
    task = of_task(cls, said["task"], trainer) if said.get("task") else None
    given = task or cls()
    resumes = (given.resume or "resume" in said) and "no_resume" not in said
    if not resumes or "help" in said or "-h" in arguments:
        return parse(cls, arguments, prog, default=task)
    out = Path(said.get("out", given.out))
    path, saved = _saved_options(out, algorithms)
    made = resumed(path, saved | {"out": str(out), "resume": True}, given, {*said, "out"})
    return parse(cls, arguments, prog, default=made)


def _saved_options(out: Path, algorithms: Sequence[str]) -> tuple[Path, dict[str, Any]]:
    """The options of the run in ``out``, and the file that has them."""
    from ms_slam_agents.learning_curve import LATEST, read_curve  # here: only this needs torch
    from ms_slam_agents.policy_file import read_policy

    path, curve = out / LATEST, out / RESULTS
    if curve.is_file() and not path.exists():  # interrupted before there was a policy
        return curve, dict(read_curve(curve).config)
    known = read_policy(path).metadata
    if known.algorithm not in algorithms:
        raise InputError(f"{path} is of {known.algorithm}, not of {' or '.join(algorithms)}")
    return path, known.options


def resumed(path: Path, saved: Mapping[str, Any], given: P, said: Collection[str]) -> P:
    """The options of a run to resume, for what the command line does not say.

    Args:
        path: of the run's file.
        saved: options in it, as JSON has them.
        given: those of the task that the command line names, or the defaults.
        said: options that the command line says, and so counts for.

    Raises:
        InputError: options that no run has, or a text that is to be given again.
    """
    known = to_plain(asdict(given))
    for name, value in saved.items():
        if name not in said and not _may_say(name, value) and known.get(name) != value:
            option = name.replace("_", "-")
            raise InputError(
                f"{path}: option {name} = {str(value)[:80]!r} is used only if the command line "
                f"says so: give --{option} again"
            )
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in saved.items()}
    try:
        return of_types(from_dict(type(given), values), "option")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def say_changes(saved: Mapping[str, Any], args: Problem) -> None:
    """Print which options of a resumed run have changed."""
    for name, value in to_plain(asdict(args)).items():
        before = saved.get(name, value)
        if before != value and name not in ("out", "resume"):
            print(f"{name} is {value!r} from now on, {before!r} so far")


# -- What must be as it was --------------------------------------------------------------------


def check_new(out: Path, *names: str) -> None:
    """Refuse a new run in a folder that already has files of these names.

    Raises:
        InputError: there is one.
    """
    if any((out / name).exists() for name in names):
        raise InputError(f"{out} holds a training run already: add --resume, or change --out")


def check_kept(
    path: Path,
    saved: Mapping[str, Any],
    args: Problem,
    names: Iterable[str],
    was: str = "was trained with",
) -> None:
    """Refuse to resume a run with options that would make it a different one.

    What a run of earlier does not say, it had as an option is by default.

    Args:
        path: of the run.
        saved: its options.
        args: those given.
        names: of the options that must be the same.
        was: what the run or a part of it has to do with them.

    Raises:
        InputError: naming the first option that differs, and both values.
    """
    for name in names:
        had, given = saved.get(name, getattr(type(args), name)), getattr(args, name)
        had = tuple(had) if isinstance(had, list) else had  # as JSON has it
        if had != given:
            raise InputError(f"{path} {was} {name} {had!r}, not {given!r}")


def check_steps_left(path: Path, done: int, total: int) -> None:
    """Refuse to resume a run that has made all its steps.

    Raises:
        InputError: no steps are left.
    """
    if done >= total:
        raise InputError(
            f"{path} is trained for {done} steps already: give more than --total-timesteps {total}"
        )
