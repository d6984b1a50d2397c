"""All measures at once against the single ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import metrics
from ms_slam_env.errors import InputError


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 80), st.integers(1, 80), st.floats(0.01, 2.0))
def test_equals_the_single_measures(seed: int, n: int, m: int, threshold: float) -> None:
    rng = np.random.default_rng(seed)
    points, truth = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))
    found = metrics.map_quality(points, truth, [threshold])
    assert found.distance == metrics.cloud_distance(points, truth)
    assert found.hausdorff_m == metrics.hausdorff_distance(points, truth)
    assert found.precision == {threshold: metrics.precision(points, truth, threshold)}
    assert found.recall == {threshold: metrics.recall(points, truth, threshold)}
    assert found.f_score == {threshold: metrics.f_score(points, truth, threshold)}
    assert found.completion == metrics.completion(points, truth)


@pytest.mark.parametrize("thresholds", [(), (0.0,), (0.1, np.nan)])
def test_bad_thresholds_are_refused(thresholds: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="thresholds must be finite and > 0"):
        metrics.map_quality(np.zeros((3, 3)), np.zeros((3, 3)), thresholds)
