"""The device's 6x6 solve and pose update against NumPy and SciPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env._runtime.warp import wp
from ms_slam_env.geometry import se3_exp
from ms_slam_env.slam.surfel.normal_equations import (
    NUM_SUMS,
    OFF,
    RESTING,
    RUNNING,
    Hypotheses,
    Photometry,
    Sum,
)
from ms_slam_env.slam.surfel.photometry import same_exposure
from ms_slam_env.slam.surfel.solver import gauss_newton_step, reduce_sums


def _sums(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    """A system that is a quarter geometric and three quarters photometric."""
    system = np.concatenate([H[np.triu_indices(6)], g])
    sums = np.zeros(NUM_SUMS)
    sums[:27] = 0.25 * system
    sums[Sum.PHOTOMETRIC_HESSIAN : Sum.PHOTOMETRIC_HESSIAN + 27] = 0.75 * system
    return sums


def _step(H, g, T, state=RUNNING, last=0, smallest=1e-9, damping=0.0):
    one = Hypotheses()
    one.pose = wp.array(T[None, None], dtype=wp.mat44d)
    one.state = wp.array([[state]], dtype=wp.int32)
    one.photometry = wp.array(same_exposure(1)[:, None], dtype=Photometry)
    one.sums = wp.array(_sums(H, g)[None, None], dtype=wp.float64)
    wp.launch(gauss_newton_step, dim=(1, 1), inputs=[one, damping, smallest, last, 1.0])
    return one.pose.numpy()[0, 0], int(one.state.numpy()[0, 0])


@given(seed=st.integers(0, 10_000), size=st.sampled_from([1e-9, 1e-5, 1e-2, 0.5]))
@settings(max_examples=60, deadline=None)
def test_step_solves_and_applies_the_exponential(seed, size):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(30, 6)) * np.array([1, 2, 5, 10, 20, 0.1])
    H = J.T @ J
    xi = rng.normal(size=6)
    xi *= size / np.abs(xi).max()
    T = se3_exp(rng.normal(size=6))
    result, _ = _step(H, -H @ xi, T)
    np.testing.assert_allclose(result, T @ se3_exp(np.linalg.solve(H, H @ xi)), atol=1e-9)
    np.testing.assert_allclose(result[:3, :3] @ result[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_singular_system_moves_only_where_it_is_regular():
    H = np.diag([1.0, 1, 1, 1, 1, 0])
    T = se3_exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    result, _ = _step(H, [-0.01, 0, 0, 0.02, 0, 1], T)
    np.testing.assert_allclose(result, T @ se3_exp([0.01, 0, 0, -0.02, 0, 0]), atol=1e-12)
    result, state = _step(np.zeros((6, 6)), np.ones(6), T)
    np.testing.assert_allclose(result, T, atol=1e-15)
    assert state == RESTING


def test_convergence_rests_until_the_level_ends():
    H, g = np.eye(6), np.full(6, 1e-6)
    assert _step(H, g, np.eye(4), smallest=1e-3)[1] == RESTING
    assert _step(H, g, np.eye(4), smallest=1e-3, last=1)[1] == RUNNING
    assert _step(H, g, np.eye(4), state=RESTING, last=1)[1] == RUNNING


def test_resting_and_switched_off_hypotheses_keep_their_pose():
    T = se3_exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    for state in (OFF, RESTING):
        result, _ = _step(np.eye(6), np.ones(6), T, state=state)
        np.testing.assert_array_equal(result, T)
    assert _step(np.eye(6), np.ones(6), T, state=OFF, last=1)[1] == OFF


def test_reduction_adds_the_slots_of_running_hypotheses():
    rng = np.random.default_rng(0)
    partial = rng.normal(size=(2, 3, 7, NUM_SUMS)).astype(np.float32)
    states = np.array([[RUNNING, OFF, RUNNING], [RESTING, RUNNING, RUNNING]])
    hypotheses = Hypotheses()
    hypotheses.sums = wp.zeros((2, 3, NUM_SUMS), dtype=wp.float64)
    hypotheses.state = wp.array(states, dtype=wp.int32)
    hypotheses.partial = wp.array(partial, dtype=wp.float32)
    wp.launch(reduce_sums, dim=(2, 3, NUM_SUMS), inputs=[hypotheses, 5])
    expected = partial[:, :, :5].astype(np.float64).sum(2) * (states == RUNNING)[..., None]
    np.testing.assert_allclose(hypotheses.sums.numpy(), expected, atol=1e-12)
