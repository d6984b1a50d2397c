"""The benchmark of the pose's covariance, on errors whose distribution is known and a short run."""

from __future__ import annotations

import numpy as np
import pytest
from ms_slam_experiments import pose_covariance as pc

from ms_slam_env.metrics import covariance_coverage, nees
from ms_slam_env.metrics.consistency import COVERAGES


def _errors(factor: float, count: int = 20_000) -> np.ndarray:
    """Squared errors of random covariances that are ``factor`` times too small."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(count, 6, 6))
    twists = np.sqrt(factor) * (roots @ rng.normal(size=(count, 6, 1)))[..., 0]
    return nees(twists, roots @ roots.transpose(0, 2, 1))


def test_right_covariances_hold_their_promises():
    errors, promised = _errors(1.0), list(COVERAGES.values())
    np.testing.assert_allclose(list(covariance_coverage(errors).values()), promised, atol=0.01)
    assert pc.scale(errors) == pytest.approx(1.0, rel=0.03)


def test_the_factor_repairs_wrong_ones():
    errors, promised = _errors(4.0), list(COVERAGES.values())
    assert covariance_coverage(errors)["within_90"] < 0.5
    assert pc.scale(errors) == pytest.approx(4.0, rel=0.03)
    repaired = list(covariance_coverage(errors, pc.scale(errors)).values())
    np.testing.assert_allclose(repaired, promised, atol=0.01)
