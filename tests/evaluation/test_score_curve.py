"""The F-score of a growing map, against the exact measure and against areas known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env.evaluation.map_quality import ScoreCurve, map_quality


def plane(low: float, high: float, spacing_m: float) -> np.ndarray:
    """Points of the floor with x in [low, high] and y in [0, 2]."""
    x, y = np.meshgrid(np.arange(low, high, spacing_m), np.arange(0, 2, spacing_m))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_a_look_is_near_the_exact_score(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = plane(0, rng.uniform(0.5, 3), 0.008)
    points[:, 2] = rng.normal(0, 0.03, len(points))
    reference = plane(0, 2, 0.03)
    exact = map_quality(points, plane(0, 4, 0.01), ("f_score_5cm",), reference)["f_score_5cm"]
    curve = ScoreCurve(plane(0, 4, 0.02), reference)
    curve.look(0, points)
    assert curve.scores[0] == pytest.approx(exact, abs=0.03)


def test_a_map_of_everything_has_a_score_of_one_and_none_has_zero() -> None:
    floor = plane(0, 1, 0.02)
    curve = ScoreCurve(floor, floor)
    curve.look(0, np.zeros((0, 3)))
    curve.look(5, floor + np.array([0, 0, 1.0]))
    curve.look(10, floor)
    assert curve.scores == [0, 0, 1]


def test_the_area_is_that_of_lines_and_goes_on_level_at_the_end() -> None:
    curve = ScoreCurve(np.zeros((1, 3)), np.zeros((1, 3)))
    curve.steps, curve.scores = [0, 5, 8], [0.0, 0.6, 0.8]
    assert curve.area(8) == pytest.approx((5 * 0.3 + 3 * 0.7) / 8)
    assert curve.area(20) == pytest.approx((5 * 0.3 + 3 * 0.7 + 12 * 0.8) / 20)


def test_the_same_map_has_the_same_score_twice() -> None:
    points = np.random.default_rng(0).uniform(0, 2, (50_000, 3)) * (1, 1, 0.02)
    scores = []
    for _ in range(2):
        curve = ScoreCurve(plane(0, 2, 0.02), plane(0, 2, 0.03))
        curve.look(0, points)
        scores += curve.scores
    assert scores[0] == scores[1] > 0.5
