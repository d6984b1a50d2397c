"""Samplers, which propose the configurations to try: Optuna's and one more."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError
from ms_slam_env.tuning.objectives import on_front

if TYPE_CHECKING:
    from optuna.samplers import BaseSampler

Maker = Callable[[int, int], "BaseSampler"]


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
    """Gaussian processes, on one thread.

    The thread pools of PyTorch and OpenBLAS compete for cores. On two busy cores a proposal took
    8.7 s (2.5 s of processor time), and studies did not finish; on one thread it took 1.2 s (0.4 s
    of processor time), with seven parameters, a constraint, and 10 to 30 trials.
    """
    from optuna.samplers import GPSampler
    from threadpoolctl import threadpool_limits

    class OneThread(GPSampler):
        def sample_relative(self, *arguments: Any) -> dict[str, Any]:
            with threadpool_limits(1):
                return super().sample_relative(*arguments)

    return OneThread(seed=seed)


def _forest(seed: int, population: int) -> BaseSampler:
    from optuna.samplers import BaseSampler, RandomSampler
    from optuna.search_space import IntersectionSearchSpace
    from optuna.trial import TrialState

    class RandomForestSampler(BaseSampler):
        """Uses ``propose`` after the first, random trials."""

        def __init__(self) -> None:
            self._rng = np.random.default_rng(seed)
            self._random = RandomSampler(seed=seed)

        def infer_relative_search_space(self, study: Any, trial: Any) -> dict[str, Any]:
            space = IntersectionSearchSpace().calculate(study)
            return {name: kind for name, kind in space.items() if not kind.single()}

        def sample_relative(self, study: Any, trial: Any, space: Any) -> dict[str, Any]:
            done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
            too_early = len(done) < _STARTUP or self._rng.random() < _AT_RANDOM
            return {} if too_early or not space else propose(space, done, self._rng)

        def sample_independent(self, *arguments: Any) -> Any:
            return self._random.sample_independent(*arguments)

    return RandomForestSampler()


SAMPLERS: dict[str, Maker] = {
    "random": _random,
    "nsga2": _nsga2,
    "tpe": _tpe,
    "gp": _gp,
    "forest": _forest,
}
"""Name to a function that makes the sampler from a seed and a population size.

``random`` is the paper's; ``nsga2`` evolves a population; ``tpe``, ``gp`` and ``forest`` fit a
model, the last as HyperMapper does.
"""
_NEEDS = {"gp": ("torch", "PyTorch"), "forest": ("sklearn", "scikit-learn")}


def make_sampler(name: str, seed: int, population: int) -> BaseSampler:
    """Make the sampler ``name``.

    Raises:
        InputError: its library is not installed.
    """
    from optuna.exceptions import ExperimentalWarning

    module, library = _NEEDS.get(name, ("", ""))
    if module and importlib.util.find_spec(module) is None:
        raise InputError(f"sampler {name} needs {library}: pip install 'ms-slam-env[explore]'")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return SAMPLERS[name](seed, population)


# -- Active learning with random forests --------------------------------------------------------

_STARTUP = 10  # random trials before the first model
_AT_RANDOM = 0.05  # share of random trials later on, which reveal errors of the model
_POOL = 1000  # random configurations to predict, and as many close to the front
_TREES = 32
_LIKELY = 0.5  # least probability at which a configuration counts as feasible


def propose(space: Mapping[str, Any], done: list[Any], rng: np.random.Generator) -> dict[str, Any]:
    """Propose a random configuration from the Pareto front that random forests predict.

    One forest predicts each objective, another whether a configuration is feasible, that is, meets
    the constraints and does not fail. Nardi, Koeplinger, Olukotun: Practical Design Space
    Exploration (HyperMapper), MASCOTS 2019. There the whole predicted front is evaluated before the
    forests are refitted; here it is one configuration at a time. A pool of configurations
    represents the space: half are drawn from it, half are variations of the current front.

    Args:
        space: Optuna's distributions by name.
        done: Optuna's finished trials.
        rng: random generator.

    Returns:
        a value for each name in ``space``.
    """
    from optuna._transform import _SearchSpaceTransform
    from sklearn.ensemble import RandomForestClassifier, RandomForestRegressor

    coded = _SearchSpaceTransform(dict(space), transform_0_1=True)
    points = np.array([coded.transform({n: t.params[n] for n in space}) for t in done])
    values = np.array([trial.values for trial in done], dtype=np.float64)
    kept = np.array([all(v <= 0 for v in trial.constraints.values()) for trial in done])
    learnt = kept if kept.sum() >= 2 else np.ones(len(done), dtype=bool)
    best = points[learnt][on_front(values[learnt])]
    pool = np.vstack([rng.random((_POOL, points.shape[1])), _changed(best, rng)])
    seed = int(rng.integers(2**31))
    if kept.any() and not kept.all():
        judge = RandomForestClassifier(_TREES, random_state=seed).fit(points, kept)
        likely = judge.predict_proba(pool)[:, 1]
        pool = pool[likely >= min(_LIKELY, likely.max())]
    predicted = np.stack(
        [
            RandomForestRegressor(_TREES, max_features=0.75, random_state=seed)
            .fit(points[learnt], column)
            .predict(pool)
            for column in values[learnt].T
        ],
        axis=1,
    )
    found = [coded.untransform(row) for row in pool[on_front(predicted)]]
    known = [{name: trial.params[name] for name in space} for trial in done]
    fresh = [params for params in found if params not in known]
    return fresh[rng.integers(len(fresh))] if fresh else {}


def _changed(best: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Variations (_POOL, d) of points (n, d), with one or two coordinates redrawn or shifted."""
    rows = best[rng.integers(len(best), size=_POOL)]
    drawn = np.where(
        rng.random(rows.shape) < 0.5,
        rng.random(rows.shape),
        np.clip(rows + rng.normal(0.0, 0.1, rows.shape), 0.0, 1.0),
    )
    is_other = rng.random(rows.shape) < 1.5 / rows.shape[1]
    return np.where(is_other, drawn, rows)
