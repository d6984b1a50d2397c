"""Consistency of covariances against SciPy, closed forms, random errors and smfeval."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import mahalanobis
from scipy.stats import chi2

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import adjoint, invert, se3_exp, se3_log
from ms_slam_env.metrics import (
    covariance_coverage,
    motion_twists,
    nees,
    nees_limits,
    pose_twists,
    silently_wrong,
)

SIGMAS = np.array([1e-3, 2e-3, 4e-3, 2e-3, 1e-3, 5e-4])


def random_covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    """Covariances (count, 6, 6) of millimetres and milliradians, none diagonal."""
    roots = rng.normal(size=(count, 6, 6)) * SIGMAS[:, None]
    return roots @ np.swapaxes(roots, 1, 2) + np.diag(SIGMAS**2)


def walk(rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses (count, 4, 4) of a camera that moves and turns."""
    poses = [se3_exp(rng.normal(size=6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3_exp(rng.normal(0, [0.1] * 3 + [0.2] * 3)))
    return np.array(poses)


def disturbed(rng: np.random.Generator, truth: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Estimates whose errors are drawn from ``C``: the truth is estimate exp(xi)."""
    xi = (np.linalg.cholesky(C) @ rng.normal(size=(len(C), 6, 1)))[..., 0]
    return np.array([T @ invert(se3_exp(x)) for T, x in zip(truth, xi, strict=True)])


def test_nees_is_the_squared_mahalanobis_distance() -> None:
    rng = np.random.default_rng(0)
    for dimensions in (1, 3, 6):
        xi = rng.normal(size=(20, dimensions))
        C = np.array([np.cov(rng.normal(size=(dimensions, 50))) for _ in xi])
        C = C.reshape(-1, dimensions, dimensions)
        inverses = np.linalg.inv(C)
        expected = [
            mahalanobis(x, np.zeros(dimensions), VI) ** 2
            for x, VI in zip(xi, inverses, strict=True)
        ]
        np.testing.assert_allclose(nees(xi, C), expected)


def test_limits_are_those_of_chi_squared() -> None:
    shares = np.array([0.5, 0.9, 0.95])
    np.testing.assert_allclose(nees_limits(shares, 2), -2 * np.log(1 - shares))  # closed form
    np.testing.assert_allclose(chi2.cdf(nees_limits(shares), 6), shares)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_right_covariances_cover_what_they_promise(factor: float) -> None:
    rng = np.random.default_rng(1)
    C = random_covariances(rng, 4000)
    truth = np.tile(se3_exp(rng.normal(size=6)), (len(C), 1, 1))
    squared = nees(pose_twists(disturbed(rng, truth, factor * C), truth), C)
    assert squared.mean() / 6 == pytest.approx(factor, rel=0.05)
    found = list(covariance_coverage(squared, factor).values())
    np.testing.assert_allclose(found, [0.5, 0.9, 0.95], atol=0.025)
    if factor > 1:
        assert covariance_coverage(squared)["within_90"] < 0.3


def test_errors_of_motions_have_the_covariance_that_is_said() -> None:
    rng = np.random.default_rng(2)
    count = 3000
    truth, C = walk(rng, 2), random_covariances(rng, 2)
    truth, C = np.tile(truth, (count, 1, 1)), np.tile(C, (count, 1, 1))
    first = np.arange(0, 2 * count, 2)
    estimate = disturbed(rng, truth, C)
    xi, said = motion_twists(estimate, truth, C, first, first + 1)
    np.testing.assert_allclose(np.cov(xi.T), said.mean(axis=0), atol=0.1 * said[0].max())
    assert nees(xi, said).mean() / 6 == pytest.approx(1, rel=0.05)


def test_drift_of_the_world_is_no_error_of_motions() -> None:
    rng = np.random.default_rng(3)
    truth = walk(rng, 30)
    estimate = se3_exp(rng.normal(size=6)) @ truth
    C, first = random_covariances(rng, 30), np.arange(29)
    xi, _ = motion_twists(estimate, truth, C, first, first + 1)
    np.testing.assert_allclose(xi, 0, atol=1e-12)
    assert np.abs(pose_twists(estimate, truth)).max() > 0.1


def test_the_twist_of_a_motion_is_that_of_its_ends_to_first_order() -> None:
    rng = np.random.default_rng(4)
    truth = walk(rng, 2)
    estimate = disturbed(rng, truth, np.tile(1e-4 * np.diag(SIGMAS**2), (2, 1, 1)))
    C = np.zeros((2, 6, 6))
    (xi,), _ = motion_twists(estimate, truth, C, np.array([0]), np.array([1]))
    ends = pose_twists(estimate, truth)
    motion = invert(estimate[0]) @ estimate[1]
    np.testing.assert_allclose(xi, ends[1] - adjoint(invert(motion)) @ ends[0], atol=1e-8)
    np.testing.assert_allclose(estimate[1] @ se3_exp(ends[1]), truth[1], atol=1e-12)
    np.testing.assert_allclose(ends[0], se3_log(invert(estimate[0]) @ truth[0]))


def test_silent_is_what_is_wrong_by_more_than_it_admits() -> None:
    truth = np.tile(np.eye(4), (4, 1, 1))
    estimate = truth.copy()
    estimate[:, 0, 3] = [0.009, 0.011, 0.05, 0.05]
    C = np.zeros((4, 6, 6))
    C[:, 0, 0] = np.array([1e-3, 1e-3, 0.017, 0.016]) ** 2
    assert silently_wrong(estimate, truth, C).tolist() == [False, True, False, True]


def test_bad_input_is_refused() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(InputError, match="singular"):
        nees(np.ones((2, 6)), np.zeros((2, 6, 6)))
    with pytest.raises(InputError, match="got"):
        nees(np.ones((2, 6)), np.zeros((2, 3, 3)))
    with pytest.raises(InputError, match=r"\(3, 6, 6\)"):
        silently_wrong(poses, poses, np.zeros((2, 6, 6)))
    with pytest.raises(InputError, match=r"\(3, 6, 6\)"):
        motion_twists(poses, poses, np.zeros((2, 6, 6)), np.array([0]), np.array([1]))


def test_smfeval_agrees_on_positions() -> None:
    """An independent implementation, which scores positions alone, of absolute errors."""
    logscore = pytest.importorskip("smfeval.scoring.logscore", reason="smfeval is not installed")
    from scipy.spatial.transform import Rotation
    from smfeval.scoring.calibration import calibrate
    from smfeval.steps import GaussianStep

    rng = np.random.default_rng(5)
    truth, C = walk(rng, 200), random_covariances(rng, 200)
    estimate = disturbed(rng, truth, 2.0 * C)
    quaternions = Rotation.from_matrix(estimate[:, :3, :3]).as_quat()
    true_quaternions = Rotation.from_matrix(truth[:, :3, :3]).as_quat()
    steps = [
        GaussianStep(0.1 * k, estimate[k, :3, 3], quaternions[k], C[k])
        for k in range(len(estimate))
    ]
    own = nees(pose_twists(estimate, truth)[:, :3], C[:, :3, :3])
    theirs = [
        logscore.gaussian_log_score_components(step, T[:3, 3], q).translation.nees
        for step, T, q in zip(steps, truth, true_quaternions, strict=True)
    ]
    np.testing.assert_allclose(own, theirs, rtol=1e-6)
    verdict = logscore.anees_consistency(own, dof=3)
    assert verdict.verdict == "optimistic"
    assert verdict.anees == pytest.approx(own.mean())
    met = calibrate(steps, truth[:, :3, 3], true_quaternions, alpha=0.1).coverage
    assert met == pytest.approx(covariance_coverage(own, dimensions=3)["within_90"])
