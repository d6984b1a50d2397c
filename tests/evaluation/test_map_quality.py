"""The measures of a map together, against the single ones, and while it grows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import metrics
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation import map_quality as module
from ms_slam_env.evaluation.map_quality import ComparedMap, ScoreCurve, map_quality, share_keys
from ms_slam_env.metrics.registry import metric

EVERY = (*module.STANDARD, *module._MEASURES)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 80), st.integers(1, 80), st.integers(1, 200))
def test_equals_the_single_measures(seed: int, n: int, m: int, centimetres: int) -> None:
    rng = np.random.default_rng(seed)
    points, truth = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))
    thinned = metrics.voxel_downsample(points, 0.3)
    distances = metrics.nearest_distances(thinned, truth)
    shares = share_keys([centimetres / 100])
    found = map_quality(points, truth, (*shares, *EVERY), voxel_m=0.3)
    pair = thinned, truth, centimetres / 100
    assert [found[key] for key in shares] == [
        metrics.precision(*pair), metrics.recall(*pair), metrics.f_score(*pair)
    ]  # fmt: skip
    assert found["rcm"] == found["completion_ratio"] == metrics.rcm(thinned, truth)
    assert found["rer_m"] == metrics.rer(thinned, truth)
    assert found["map_error_median_m"] == np.median(distances)
    assert found["map_error_capped_rms_m"] == np.sqrt((np.minimum(distances, 0.1) ** 2).mean())
    assert found["c2c_mean_m"] == metrics.cloud_distance(thinned, truth).mean
    assert found["hausdorff_directed_m"] == metrics.hausdorff_distance(thinned, truth, False)
    assert found["hausdorff_m"] == metrics.hausdorff_distance(thinned, truth)
    assert found["completion_cm"] == metrics.completion(thinned, truth).completion_cm
    assert found["map_points"] == n


def test_searches_only_for_what_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        module, "nearest_distances", lambda a, b: asked.append((len(a), len(b))) or np.ones(len(a))
    )
    map_quality(np.eye(3), np.zeros((5, 3)), ("map_error_median_m", "c2c_mean_m"))
    assert asked == [(3, 5)]


def test_a_registered_map_is_judged_where_it_lies() -> None:
    moved = np.random.default_rng(0).uniform(size=(500, 3))
    there = ComparedMap(moved + 0.02, moved, voxel_m=0, registered=True)
    assert there.rer() == metrics.rer(moved + 0.02, moved, "none")
    assert there.rer() > ComparedMap(moved + 0.02, moved, voxel_m=0).rer()


def test_every_measure_is_registered_and_keys_of_thresholds_too() -> None:
    assert {metric(key).key for key in EVERY} == set(EVERY)
    found = metric("recall_3.5cm")
    assert (found.heading, found.definition) == (
        "recall at 3.5 cm", "Share of the true surface within 3.5 cm of a map point."
    )  # fmt: skip
    with pytest.raises(InputError, match="unknown metric 'width_3cm'"):
        metric("width_3cm")


def test_refuses_unknown_measures_and_bad_thresholds() -> None:
    with pytest.raises(InputError, match="unknown measure of a map 'beauty'; valid choices: prec"):
        map_quality(np.eye(3), np.eye(3), ("beauty",))
    for thresholds in ((), (0.0,), (0.1, np.nan)):
        with pytest.raises(InputError, match="thresholds must be finite and > 0"):
            share_keys(thresholds)


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
