"""Experiments by name: each file of ``ms_slam_env/experiments`` is one, others a user's."""

from __future__ import annotations

import inspect
import pkgutil
from importlib import import_module
from typing import Any

import ms_slam_env.experiments
from ms_slam_env.experiments.harness.experiment import Experiment
from ms_slam_env.extension import ExtensionPoint


def experiment_names() -> tuple[str, ...]:
    """Names of all experiments, sorted."""
    modules = pkgutil.iter_modules(ms_slam_env.experiments.__path__)
    return tuple(sorted(module.name for module in modules if not module.ispkg))


EXPERIMENTS = ExtensionPoint(
    "experiment",
    "ms_slam_env.experiments",
    Experiment,
    own={name: f"{ms_slam_env.experiments.__name__}.{name}" for name in experiment_names()},
)
"""Where experiments are found; ours are modules that are not imported before."""


def experiment_class(name: str) -> type[Experiment]:
    """The experiment of a name; ``step-size`` and ``step_size`` are the same.

    Raises:
        InputError: an unknown name; the message lists the valid ones.
    """
    module_name = name.replace("-", "_")
    found: Any = EXPERIMENTS.find(module_name if module_name in EXPERIMENTS.own else name)
    if not isinstance(found, str):
        return found
    module = import_module(found)
    (own,) = [
        cls
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, Experiment) and cls.__module__ == module.__name__
    ]
    return own
