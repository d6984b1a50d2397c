"""Entry point through which Gymnasium makes the registered environments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env._runtime.extension import load_reference
from ms_slam_env.config import is_options, parse_named
from ms_slam_env.env.active_slam import VIEWS, ActiveSlamEnv
from ms_slam_env.env.env_config import EnvConfig
from ms_slam_env.env.reward import DEFAULT, MAPPING
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.sequences.perturbations import make_perturbation
from ms_slam_env.tasks import Task, find_task

_FASTER = 2.0  # default speed-up of the ids with fast motion


def make_env(task: Any = None, perturbed_by: str | None = None, **options: Any) -> ActiveSlamEnv:
    """Make an environment, with or without a task and a perturbation; entry point of every id.

    Raises:
        InputError: an unknown task, perturbation or option, or a value out of range.
    """
    env = _make(task, perturbed_by, **options)
    if env.render_mode == "human":
        env.make_view = load_reference(VIEWS["human"])
    return env


def _make(task: Any, perturbed_by: str | None, **options: Any) -> ActiveSlamEnv:
    if task is not None:
        return _make_for(find_task(task), perturbed_by, **options)
    if perturbed_by is None:
        return ActiveSlamEnv(**options)
    return _make_perturbed(perturbed_by, **options)


# Gymnasium reads the render modes here before it makes the environment.
make_env.metadata = {"render_modes": [*VIEWS]}  # type: ignore[attr-defined]


def _make_for(task: Task, perturbed_by: str | None, **options: Any) -> ActiveSlamEnv:
    """Build the environment of a task; see `options_for`."""
    env = _make(None, perturbed_by, **options_for(task, options))
    for name, strength in task.perturbations.items():
        env.perturb(make_perturbation(name, strength))
    return env


def options_for(task: Task, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a task's environment: the task's own, overridden by ``options``.

    The reward is ``mapping`` unless the task has its own; weights without a name change it.
    Single options of ``slam_config`` are overridden, too. The task's are dropped for another SLAM.
    """
    own: dict[str, Any] = {"scene": task.scenes, "reward": MAPPING, **task.options}
    reward = options.get("reward", DEFAULT)
    if isinstance(reward, str) and reward == DEFAULT:
        options = {**options, "reward": own["reward"]}
    elif is_options(reward) and "name" not in reward:
        base = own["reward"] if is_options(own["reward"]) else {"name": own["reward"]}
        options = {**options, "reward": {**base, **reward}}
    configured, given = own.pop("slam_config", {}), options.get("slam_config", {})
    slam = options.get("slam", "surfel")
    is_surfel = isinstance(slam, str) and parse_named(slam, "backend")[0] == "surfel"
    if is_surfel and is_options(given):
        options = {**options, "slam_config": {**configured, **given}}
    return {**own, **options}


def _make_perturbed(
    name: str, perturbation: Mapping[str, Any] | None = None, **options: Any
) -> ActiveSlamEnv:
    """Build an environment with one perturbation, whose options are ``perturbation``.

    ``fast-motion`` makes every motion of a free camera ``factor`` (2) times as large in the same
    time; every other perturbation applies to the camera's frames.

    Raises:
        InputError: an unknown option, or a value out of range.
    """
    given = {} if perturbation is None else perturbation
    if not is_options(given):
        raise InputError(f"perturbation = {perturbation!r} must be a mapping of options of {name}")
    strength = dict(given)
    if name == "fast-motion":
        return ActiveSlamEnv(**_hurried(strength, options))
    env = ActiveSlamEnv(**options)
    env.perturb(make_perturbation(name, strength))
    return env


def _hurried(strength: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """``options`` with larger motions."""
    for name in strength:
        if name != "factor":
            raise unknown("option of fast-motion in an environment", name, ("factor",))
    if options.get("embodiment") not in ("free", "fixed-translation"):
        raise InputError("fast-motion needs a free camera: an arm moves as fast as its joints")
    fast: Any = make_perturbation("fast-motion", {"factor": _FASTER, **strength})
    steps = {name: options.get(name, getattr(EnvConfig, name)) for name in ("step_m", "step_rad")}
    EnvConfig(**steps)  # refuses invalid lengths
    return {**options, **{name: fast.factor * step for name, step in steps.items()}}
