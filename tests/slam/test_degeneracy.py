"""Eigenvectors, the remapped step, and views that leave directions of the pose open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.slam.surfel.solver import eigen, mat66d, mat76d, remapped_step, vec6d

CAMERA = Intrinsics(fx=146.0, fy=146.0, cx=79.5, cy=59.5, width=160, height=120)


@wp.kernel
def _eigen(H: wp.array(dtype=mat66d), out: wp.array(dtype=mat76d)):
    out[0] = eigen(H[0])


@wp.kernel
def _step(
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
    wp.launch(_step, dim=1, inputs=[terms, right, tilted, matched], outputs=[out])
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
