"""Samplers by name."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from optuna.samplers import BaseSampler


def _random(seed: int, population: int) -> BaseSampler:
    from optuna.samplers import RandomSampler

    return RandomSampler(seed=seed)


def _nsga2(seed: int, population: int) -> BaseSampler:
    from optuna.samplers import NSGAIISampler

    return NSGAIISampler(seed=seed, population_size=population)


def _tpe(seed: int, population: int) -> BaseSampler:
    from optuna.samplers import TPESampler

    return TPESampler(seed=seed, multivariate=True)


def _gp(seed: int, population: int) -> BaseSampler:
    from optuna.samplers import GPSampler

    return GPSampler(seed=seed)


SAMPLERS: dict[str, Callable[[int, int], BaseSampler]] = {
    "random": _random,
    "nsga2": _nsga2,
    "tpe": _tpe,
    "gp": _gp,
}
"""Name to maker; a maker takes the seed and the size of a population.

``random`` is the paper's; ``nsga2`` evolves a population, ``tpe`` and ``gp`` fit a model.
"""


def make_sampler(name: str, seed: int, population: int) -> BaseSampler:
    """Make the sampler ``name``.

    Raises:
        InputError: its library is not installed.
    """
    from optuna.exceptions import ExperimentalWarning

    if name == "gp" and importlib.util.find_spec("torch") is None:
        raise InputError("sampler gp needs PyTorch: pip install 'ms-slam-env[explore]'")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return SAMPLERS[name](seed, population)
