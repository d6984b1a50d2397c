"""Experiments by name: each file of ``ms_slam_env/experiments`` is one."""

from __future__ import annotations

import inspect
import pkgutil
from importlib import import_module

import ms_slam_env.experiments
from ms_slam_env.errors import unknown
from ms_slam_env.experiments.harness.experiment import Experiment


def experiment_names() -> tuple[str, ...]:
    """Names of all experiments, sorted."""
    modules = pkgutil.iter_modules(ms_slam_env.experiments.__path__)
    return tuple(sorted(module.name for module in modules if not module.ispkg))


def experiment_class(name: str) -> type[Experiment]:
    """The experiment of a name; ``step-size`` and ``step_size`` are the same.

    Raises:
        InputError: an unknown name; the message lists the valid ones.
    """
    module_name = name.replace("-", "_")
    if module_name not in experiment_names():
        raise unknown("experiment", name, experiment_names())
    module = import_module(f"{ms_slam_env.experiments.__name__}.{module_name}")
    (found,) = [
        cls
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, Experiment) and cls.__module__ == module.__name__
    ]
    return found
