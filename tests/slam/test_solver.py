"""The device's 6x6 solve against NumPy and SciPy; views that leave directions open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, RGBDFrame
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
from ms_slam_env.slam.surfel.solver import (
    eigen,
    gauss_newton_step,
    mat66d,
    mat76d,
    reduce_sums,
    remapped_step,
    vec6d,
)


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


CAMERA = Intrinsics(fx=146.0, fy=146.0, cx=79.5, cy=59.5, width=160, height=120)


@wp.kernel
def _eigen(H: wp.array(dtype=mat66d), out: wp.array(dtype=mat76d)):
    out[0] = eigen(H[0])


@wp.kernel
def _remap(
    terms: wp.array(dtype=mat66d),
    gradient: wp.array(dtype=vec6d),
    tilted: wp.float64,
    matched: wp.float64,
    out: wp.array(dtype=vec6d),
):
    out[0] = remapped_step(terms[0], terms[1], gradient[0], tilted, matched, wp.float64(0.0))


def _decompose(H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    out = wp.zeros(1, dtype=mat76d)
    wp.launch(_eigen, dim=1, inputs=[wp.array(H[None], dtype=mat66d)], outputs=[out])
    return out.numpy()[0, 6], out.numpy()[0, :6]


def _remapped(A, B, gradient, tilted=0.0, matched=0.0) -> np.ndarray:
    out = wp.zeros(1, dtype=vec6d)
    terms = wp.array(np.stack([A, B]), dtype=mat66d)
    right = wp.array(np.asarray(gradient, dtype=float)[None], dtype=vec6d)
    wp.launch(_remap, dim=1, inputs=[terms, right, tilted, matched], outputs=[out])
    return out.numpy()[0]


@given(seed=st.integers(0, 10_000), rank=st.integers(0, 6))
@settings(max_examples=60, deadline=None)
def test_eigenvectors_equal_numpys(seed, rank):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(rank, 6)) * 10 ** rng.uniform(-3, 3, 6)
    H = J.T @ J
    values, vectors = _decompose(H)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(6), atol=1e-12)
    scale = max(np.abs(H).max(), 1e-300)
    np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T / scale, H / scale, atol=1e-12)
    np.testing.assert_allclose(np.sort(values) / scale, np.linalg.eigvalsh(H) / scale, atol=1e-12)


def test_a_regular_system_is_solved():
    rng = np.random.default_rng(0)
    J, K = rng.normal(size=(2, 30, 6)) * 100
    A, B, gradient = J.T @ J, K.T @ K, rng.normal(size=6)
    expected = -np.linalg.solve(A + B, gradient)
    np.testing.assert_allclose(_remapped(A, B, gradient, matched=30.0), expected, atol=1e-12)


def test_no_step_along_directions_that_hardly_count():
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(6, 6)))[0]
    values = np.array([1e5, 1e4, 1e4, 3e3, 600.0, 400.0])  # 1000 points: 500 is least
    gradient = Q @ np.ones(6)
    step = _remapped(Q @ np.diag(values) @ Q.T, np.zeros((6, 6)), gradient, matched=1000.0)
    np.testing.assert_allclose(Q.T @ step, [*(-1 / values[:5]), 0], atol=1e-12)


def test_noisy_normals_count_for_nothing_but_grey_values_do():
    A = np.diag([600.0, 600, 1e6, 1e6, 1e6, 600])
    B = np.diag([0.0, 600, 0, 0, 0, 0])
    step = _remapped(A, B, -np.ones(6), tilted=1000.0, matched=1000.0)
    np.testing.assert_allclose(step, [0, 1 / 1200, 1e-6, 1e-6, 1e-6, 0], atol=1e-15)


def _views(kind: str, count: int) -> list[RGBDFrame]:
    """A wall 1.5 m away, blank or painted, or with a floor, passed sideways with noise."""
    rng = np.random.default_rng(0)
    painting = np.kron(rng.integers(40, 220, (60, 120)), np.ones((12, 12)))
    frames = []
    for index in range(count):
        rays = CAMERA.rays()
        z = 1.5 / rays[..., 2]
        if kind == "corner":
            below = rays[..., 1] > 1e-3
            z = np.where(below, np.minimum(z, 0.4 / np.where(below, rays[..., 1], 1.0)), z)
        points = rays * z[..., None] + [0.005 * index, 0, 0]
        grey = np.full(CAMERA.shape, 128.0)
        if kind == "painted":
            rows, columns = ((points[..., k] * 200 + 360).astype(int) for k in (1, 0))
            grey = painting[rows, columns]
        disparity = 43.9 / z + rng.normal(0, 0.07, CAMERA.shape)
        grey = np.clip(grey + rng.normal(0, 1, CAMERA.shape), 0, 255).astype(np.uint8)
        depth = (43.9 / (np.round(disparity * 8) / 8)).astype(np.float32)
        frames.append(RGBDFrame(np.repeat(grey[..., None], 3, axis=2), depth))
    return frames


@pytest.mark.parametrize(("kind", "directions"), [("blank", 3), ("corner", 1), ("painted", 0)])
def test_views_say_how_many_directions_they_leave_open(kind, directions):
    backend = slam.make("surfel", CAMERA, max_surfels=60_000)
    backend.reset()
    results = [backend.track(frame) for frame in _views(kind, 10)]
    assert all(result.tracking_ok for result in results)
    assert sum(result.degenerate for result in results[2:]) >= (6 if directions else 0)
    assert directions or not any(result.degenerate for result in results)
    assert np.median([result.degenerate_directions for result in results[2:]]) == directions
    for result in results[1:]:
        np.testing.assert_array_equal(result.covariance, result.covariance.T)
        assert np.linalg.eigvalsh(result.covariance).min() > 0
    sigmas = np.sqrt(np.diag(results[-1].covariance))
    # Centimetres where the pose is only predicted, a millimetre where it is measured.
    assert (sigmas[:3] > 0.01).tolist() == [kind != "painted", kind == "blank", False]
    x, y, z = results[-1].T_world_camera[:3, 3]
    # What is constrained is right; what is not stays near where it was, at rest.
    assert abs(z) < 0.003
    assert x == pytest.approx(0.045 if kind == "painted" else 0.0, abs=0.012)
    if kind != "blank":
        assert abs(y) < 0.004
