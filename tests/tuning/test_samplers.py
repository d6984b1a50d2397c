"""Samplers on a function whose front is known in closed form, with what is not feasible in it."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import optuna
import pytest

from ms_slam_env.errors import InputError
from ms_slam_env.tuning.front import hypervolume
from ms_slam_env.tuning.samplers import SAMPLERS, make_sampler, propose

DIMENSIONS = 5
CORNER = (1.0, 6.0)


def zdt1(x: np.ndarray) -> tuple[float, float]:
    """Zitzler, Deb, Thiele 2000: its front is f2 = 1 - sqrt(f1), at x[1:] = 0."""
    g = 1 + 9 * np.mean(x[1:])
    return float(x[0]), float(g * (1 - np.sqrt(x[0] / g)))


def is_feasible(x: np.ndarray) -> bool:
    """Not where the front would be, but close to it."""
    return bool(x[1] + x[2] > 0.2)


def dominated_share(sampler: str, seed: int, trials: int) -> float:
    """Hypervolume after so many trials, a sampler made anew for each as a study on disk does."""
    study = optuna.create_study(directions=["minimize"] * 2)
    space = {f"x{k}": optuna.distributions.FloatDistribution(0, 1) for k in range(DIMENSIONS)}
    found = []
    for number in range(trials):
        study.sampler = make_sampler(sampler, 1000 * seed + number, 10)
        trial = study.ask(space)
        x = np.array([trial.params[name] for name in space])
        trial.set_constraint("failed", 0.0 if is_feasible(x) else 1.0)
        study.tell(trial, zdt1(x))
        if is_feasible(x):
            found.append(zdt1(x))
    return hypervolume(found, CORNER) / np.prod(CORNER)


def test_the_forest_beats_chance_at_equal_budget():
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    medians = {
        name: np.median([dominated_share(name, seed, 26) for seed in range(3)])
        for name in ("random", "forest")
    }
    assert medians["forest"] > medians["random"] + 0.08
    assert medians["forest"] < 1 - 1 / 3 / 6  # the whole front leaves a third of a unit


class Done:
    """A finished trial as ``propose`` takes it."""

    def __init__(self, params: dict, values: tuple[float, float], violation: float) -> None:
        self.params, self.values = params, values
        self.constraints = {"failed": violation}


@pytest.mark.parametrize("seed", [0, 1])
def test_the_forest_keeps_away_from_what_fails(seed):
    """Whatever is good has failed so far: proposals lie where nothing has."""
    rng = np.random.default_rng(seed)
    space = {
        "x": optuna.distributions.FloatDistribution(1e-3, 1.0, log=True),
        "kind": optuna.distributions.CategoricalDistribution(("a", "b")),
        "n": optuna.distributions.IntDistribution(1, 6),
    }
    done = []
    for x in np.geomspace(1e-3, 1.0, 30):
        params = {"x": float(x), "kind": str(rng.choice(["a", "b"])), "n": int(rng.integers(1, 7))}
        done.append(Done(params, (float(x), 1.0), 1.0 if x < 0.03 else 0.0))
    for _ in range(3):
        proposed = propose(space, done, rng)
        assert set(proposed) == set(space)
        assert 0.01 < proposed["x"] < 0.2
        assert all(kind._contains(kind.to_internal_repr(proposed[name])) for name, kind in
                   space.items())  # fmt: skip
        assert proposed not in [trial.params for trial in done]


def test_a_proposal_follows_from_the_seed():
    first, again = (dominated_share("forest", 3, 13) for _ in range(2))
    assert first == again


def test_nothing_feasible_yet_is_no_reason_to_stop():
    space = {"x": optuna.distributions.FloatDistribution(0.0, 1.0)}
    done = [Done({"x": x}, (x, 1 - x), 1.0) for x in np.linspace(0, 1, 12)]
    assert 0 <= propose(space, done, np.random.default_rng(0))["x"] <= 1


def test_a_missing_library_is_one_line(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for name, library in (("gp", "PyTorch"), ("forest", "scikit-learn")):
        with pytest.raises(InputError, match=f"sampler {name} needs {library}: pip install"):
            make_sampler(name, 0, 10)
    for name in set(SAMPLERS) - {"gp", "forest"}:
        make_sampler(name, 0, 10)


def test_gaussian_processes_keep_to_one_thread():
    """In a process whose pools are as large as they come, and afterwards they are so again."""
    pytest.importorskip("torch")
    code = """
import optuna
from threadpoolctl import threadpool_info
from ms_slam_env.tuning.samplers import make_sampler
seen = []
import optuna.samplers
ask = optuna.samplers.GPSampler.sample_relative
def watched(*arguments):
    seen.append(max(pool["num_threads"] for pool in threadpool_info()))
    return ask(*arguments)
optuna.samplers.GPSampler.sample_relative = watched
study = optuna.create_study(sampler=make_sampler("gp", 0, 10))
before = max(pool["num_threads"] for pool in threadpool_info())
study.optimize(lambda trial: trial.suggest_float("x", 0, 1), n_trials=12)
after = max(pool["num_threads"] for pool in threadpool_info())
print(before, max(seen), after)
"""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    before, during, after = map(int, done.stdout.split())
    assert during == 1
    assert after >= before
