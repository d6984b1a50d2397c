"""Pareto fronts, hypervolume and choices against slow, obvious versions."""

import itertools

import numpy as np
import pytest
from fake_evaluation import FakeEvaluation, fake_space, values
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.tuning import ExplorationSettings, explore
from ms_slam_env.tuning.choices import choose, knee
from ms_slam_env.tuning.front import (
    Point,
    hypervolume,
    hypervolume_history,
    importances,
    points_of,
)

REFERENCE = 6  # of the tests on a grid of unit cells


def points_on_a_grid(dimensions: int):
    point = st.lists(st.integers(0, 8), min_size=dimensions, max_size=dimensions)
    return st.lists(point, max_size=7)


def counted_cells(points, dimensions: int) -> int:
    """Unit cells of the box that some point dominates."""
    cells = itertools.product(range(REFERENCE), repeat=dimensions)
    return sum(
        any(all(p <= c for p, c in zip(point, cell, strict=True)) for point in points)
        for cell in cells
    )


@settings(deadline=None)  # a busy machine is no failure
@given(st.data())
@pytest.mark.parametrize("dimensions", [2, 3])
def test_hypervolume_is_the_number_of_cells_dominated(dimensions, data):
    points = data.draw(points_on_a_grid(dimensions))
    expected = counted_cells(points, dimensions)
    assert hypervolume(points, [REFERENCE] * dimensions) == pytest.approx(expected, abs=1e-9)


def point(number, error, cost, feasible=True, is_default=False, on_front=True) -> Point:
    return Point(number, {}, {}, (error, cost), feasible, on_front, is_default)


@settings(deadline=None)  # a busy machine is no failure
@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8), st.booleans()), max_size=9))
def test_the_history_never_falls_and_ignores_what_is_not_feasible(raw):
    points = [point(k, e, c, ok) for k, (e, c, ok) in enumerate(raw)]
    reference = {"ate_m": REFERENCE, "ext_ms": REFERENCE}
    history = hypervolume_history(points, reference, ("ate_m", "ext_ms"))
    for k, value in enumerate(history):
        feasible = [p.values for p in points[: k + 1] if p.feasible]
        assert value == pytest.approx(counted_cells(feasible, 2) / REFERENCE**2, abs=1e-9)
    assert all(np.diff(history) >= -1e-12)


@pytest.fixture(scope="module")
def storage(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    settings = ExplorationSettings(sampler="random", constraints=("ate_m<0.04",))
    return explore(folder, fake_space(), settings, FakeEvaluation(lost_from=6.0), 30)


def test_the_front_is_what_no_feasible_trial_dominates(storage):
    points = points_of(storage)
    assert points[0].is_default
    assert any(not p.feasible for p in points)
    assert any(p.measured.get("failure") for p in points)
    for p in points:
        measured = values(p.params, 6.0)
        assert p.feasible == (measured["ate_m"] <= 0.04 and "failure" not in measured)
        dominated = any(
            q.feasible
            and all(a <= b for a, b in zip(q.values, p.values, strict=True))
            and q.values != p.values
            for q in points
        )
        limits = storage.reference().values()
        counts = all(value < limit for value, limit in zip(p.values, limits, strict=True))
        assert p.on_front == (p.feasible and counts and not dominated)


def test_choices_are_what_their_names_say(storage):
    points = points_of(storage)
    default = points[0]
    chosen = choose(points, ("ate_m", "ext_ms"))
    feasible = [p for p in points if p.feasible]
    least_cost = min(p.values[1] for p in feasible if p.values[0] <= default.values[0])
    least_error = min(p.values[0] for p in feasible if p.values[1] <= default.values[1])
    assert chosen["fastest"].values[1] == least_cost
    assert chosen["most_accurate"].values[0] == least_error
    assert chosen["knee"].on_front


def test_without_a_sound_default_there_is_a_knee_only():
    points = [point(0, 9, 9, feasible=False, is_default=True, on_front=False), point(1, 1, 5)]
    assert list(choose(points, ("ate_m", "ext_ms"))) == ["knee"]
    assert choose(points[:1], ("ate_m", "ext_ms")) == {}


def test_the_knee_is_the_corner_of_the_front():
    front = [(1.0, 100.0), (1.1, 9.0), (2.0, 5.0), (10.0, 4.0), (100.0, 3.9)]
    assert knee(front) in (1, 2)
    stretched = [(1e-3 * a, 50 * b) for a, b in front]  # other units change nothing
    assert knee(stretched) == knee(front)
    assert knee([(1.0, 2.0)]) == 0


def test_importance_finds_what_matters(storage):
    shares = importances(storage)
    assert max(shares["ext_ms"], key=shares["ext_ms"].get) == "depth_cutoff_m"
    assert sum(shares["ate_m"].values()) == pytest.approx(1.0)
