"""Pose, bundle adjustment and pose graph of the sparse backend against synthetic truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, make_pose, relative_angle, se3_exp, so3_exp
from ms_slam_env.slam.shared.point_poses import (
    Sightings,
    pose_from_matches,
    refine_pose,
    residual_jacobian,
    residuals,
    weighted_residuals,
)
from ms_slam_env.slam.sparse.local_mapping import Bundle, adjust_bundle
from ms_slam_env.slam.sparse.pose_graph import Edge, optimise_poses

CAMERA = xtion("320x240")
SIGMA_PX, SIGMA_PER_M = 0.5, 0.003


def _points(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) in view of a camera near the origin."""
    depth = rng.uniform(1.0, 3.5, count)
    u, v = rng.uniform(20, 300, count), rng.uniform(20, 220, count)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    return np.stack([x * depth, y * depth, depth], axis=1)


def _see(
    pose: np.ndarray, points: np.ndarray, rng: np.random.Generator, noise: float = 0.0
) -> Sightings:
    """What a camera at a pose measures of points; every fifth depth is missing."""
    p = (points - pose[:3, 3]) @ pose[:3, :3]
    pixels = CAMERA.project(p) + noise * SIGMA_PX * rng.standard_normal((len(p), 2))
    inverse = 1 / p[:, 2] + noise * SIGMA_PER_M * rng.standard_normal(len(p))
    inverse[::5] = 0.0
    return Sightings(pixels, inverse, np.full(len(p), SIGMA_PX), SIGMA_PER_M)


def _distance(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    """Metres and radians between two poses."""
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), relative_angle(T_a[:3, :3], T_b[:3, :3])


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_jacobian_is_that_of_finite_differences(seed):
    rng = np.random.default_rng(seed)
    points = _points(7, rng)
    seen = _see(np.eye(4), points, rng, noise=1.0)
    J = residual_jacobian(points, seen, CAMERA)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        ahead = weighted_residuals(points + step, seen, CAMERA)
        behind = weighted_residuals(points - step, seen, CAMERA)
        np.testing.assert_allclose(J[:, :, axis], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-3)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_sightings_give_the_exact_pose(seed):
    rng = np.random.default_rng(seed)
    points = _points(60, rng)
    truth = se3_exp(rng.uniform(-0.1, 0.1, 6))
    start = truth @ se3_exp(rng.uniform(-0.03, 0.03, 6))
    T, inlier = refine_pose(start, points, _see(truth, points, rng), CAMERA)
    assert inlier.all()
    np.testing.assert_allclose(T, truth, atol=1e-6)


def test_outliers_are_told_and_do_no_harm():
    rng = np.random.default_rng(0)
    points = _points(200, rng)
    truth = se3_exp([0.05, -0.02, 0.03, 0.02, -0.04, 0.01])
    seen = _see(truth, points, rng, noise=1.0)
    wrong = rng.random(200) < 0.3
    seen.pixels[wrong] += rng.uniform(6, 20, (int(wrong.sum()), 2))
    T, inlier = refine_pose(np.eye(4), points, seen, CAMERA)
    assert not inlier[wrong].any()
    assert inlier[~wrong].mean() > 0.9
    metres, radians = _distance(T, truth)
    assert metres < 0.003
    assert radians < 0.002


def test_points_behind_the_camera_have_infinite_residuals():
    points = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    pixels = np.full((2, 2), [CAMERA.cx, CAMERA.cy])
    seen = Sightings(pixels, np.array([1.0, 1.0]), np.ones(2), SIGMA_PER_M)
    r, _ = residuals(np.eye(4), points, seen, CAMERA)
    assert np.isinf(r[0]).all()
    np.testing.assert_allclose(r[1], 0, atol=1e-9)


def test_pnp_finds_a_distant_pose_among_outliers_and_repeats_itself():
    rng = np.random.default_rng(1)
    points = _points(100, rng)
    truth = make_pose(so3_exp([0.1, 0.4, -0.2]), [-0.5, 0.1, 0.3])
    pixels = _see(truth, points, rng, noise=0.5).pixels
    wrong = np.arange(100) < 40
    pixels[wrong] = rng.uniform(0, 240, (40, 2))
    found = pose_from_matches(points, pixels, CAMERA, 2.0)
    assert found is not None
    T, inlier = found
    assert inlier[wrong].sum() < 4
    assert inlier[~wrong].mean() > 0.8
    metres, radians = _distance(T, truth)
    assert metres < 0.05
    assert radians < 0.02
    again = pose_from_matches(points, pixels, CAMERA, 2.0)
    assert again is not None
    np.testing.assert_array_equal(again[0], T)


def test_too_few_matches_give_no_pose():
    rng = np.random.default_rng(2)
    points = _points(5, rng)
    assert pose_from_matches(points, CAMERA.project(points), CAMERA, 2.0) is None


def _bundle(noise: float, seed: int = 0, points: int = 80) -> tuple[Bundle, np.ndarray, np.ndarray]:
    """Four cameras, displaced, that see points, displaced; true poses and points."""
    rng = np.random.default_rng(seed)
    truth = _points(points, rng)
    poses = np.stack([se3_exp(k * np.array([0.05, 0.01, 0.0, 0.0, -0.01, 0.0])) for k in range(4)])
    seen = [_see(pose, truth, rng, noise) for pose in poses]
    stacked = Sightings(
        np.concatenate([s.pixels for s in seen]),
        np.concatenate([s.inverse_depth for s in seen]),
        np.concatenate([s.sigma_px for s in seen]),
        SIGMA_PER_M,
    )
    start = poses.copy()
    for k in range(1, 4):
        start[k] = poses[k] @ se3_exp(rng.normal(0, 0.01, 6))
    bundle = Bundle(
        poses=start,
        fixed=np.array([True, False, False, False]),
        points=truth + rng.normal(0, 0.02, truth.shape),
        camera=np.repeat(np.arange(4), points),
        point=np.tile(np.arange(points), 4),
        seen=stacked,
    )
    return bundle, poses, truth


def _residuals(bundle: Bundle, poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """All residuals (O, 3) of a bundle."""
    parts = []
    for k, pose in enumerate(poses):
        here = bundle.camera == k
        seen = bundle.seen.chosen(here)
        parts.append(residuals(invert(pose), points[bundle.point[here]], seen, CAMERA)[0])
    return np.concatenate(parts)


def test_bundle_adjustment_lowers_the_reprojection_error_to_that_of_scipy():
    pytest.importorskip("gtsam")
    bundle, poses, points = _bundle(noise=1.0, points=40)

    def unknowns(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = [bundle.poses[0]]
        moved += [bundle.poses[k] @ se3_exp(x[6 * (k - 1) : 6 * k]) for k in range(1, 4)]
        return np.stack(moved), bundle.points + x[18:].reshape(-1, 3)

    def cost(x: np.ndarray) -> np.ndarray:
        return _residuals(bundle, *unknowns(x)).ravel()

    best = least_squares(cost, np.zeros(18 + 3 * 40), method="trf", x_scale="jac")
    found = adjust_bundle(bundle, CAMERA)
    before = (_residuals(bundle, bundle.poses, bundle.points) ** 2).sum()
    after = (_residuals(bundle, *found) ** 2).sum()
    assert after < 0.05 * before
    assert after < 1.02 * 2 * best.cost  # Huber's loss differs a little from squares
    scipy_poses, _ = unknowns(best.x)
    for ours, theirs, true in zip(found[0], scipy_poses, poses, strict=True):
        assert _distance(ours, theirs)[0] < 0.001
        assert _distance(ours, true)[0] < 0.006
    assert np.median(np.linalg.norm(found[1] - points, axis=1)) < 0.015


def test_bundle_adjustment_survives_a_wrong_match():
    pytest.importorskip("gtsam")
    bundle, poses, _ = _bundle(noise=0.5, seed=3)
    pixels = bundle.seen.pixels.copy()
    pixels[100] += [40.0, -30.0]
    found, _ = adjust_bundle(replace(bundle, seen=replace(bundle.seen, pixels=pixels)), CAMERA)
    for ours, true in zip(found, poses, strict=True):
        assert _distance(ours, true)[0] < 0.004


def test_pose_graph_closes_a_loop():
    pytest.importorskip("gtsam")
    count = 24
    step = make_pose(so3_exp([0.0, 2 * np.pi / count, 0.0]), [0.15, 0.0, 0.0])
    truth = [np.eye(4)]
    for _ in range(count - 1):
        truth.append(truth[-1] @ step)
    drift = se3_exp([0.002, 0.001, -0.001, 0.0, 0.004, 0.001])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step @ drift)
    drifted, true = np.stack(poses), np.stack(truth)
    edges = [Edge(k, k + 1, step @ drift) for k in range(count - 1)]
    loop = Edge(0, count - 1, invert(true[0]) @ true[-1], sigma_rad=0.0005, sigma_m=0.001)
    fixed = np.arange(count) == 0
    unchanged = optimise_poses(drifted, edges, fixed)
    np.testing.assert_allclose(unchanged, drifted, atol=1e-6)
    closed = optimise_poses(drifted, [*edges, loop], fixed)
    np.testing.assert_array_equal(closed[0], drifted[0])
    before = np.linalg.norm(drifted[:, :3, 3] - true[:, :3, 3], axis=1)
    after = np.linalg.norm(closed[:, :3, 3] - true[:, :3, 3], axis=1)
    assert before[-1] > 0.05
    assert after[-1] < 0.1 * before[-1]
    assert after.mean() < 0.5 * before.mean()
