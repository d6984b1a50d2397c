"""Equations (6) to (10) against a direct loop, and the computation of normals."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import entropy

from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.divergence import DivergenceConfig, depth_divergence, make_divergence
from ms_slam_env.divergence.sphere import bin_directions, bin_weights
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.recording import open_recording

CAMERA = xtion("80x60")
LR_KT3 = Path(__file__).resolve().parents[3] / "shared/data/icl_nuim/lr_kt3_depth"


def plane_depth(normal, distance=2.0):
    """Depth of the plane n . p = -distance with n towards the camera."""
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    return (-distance / (CAMERA.rays() @ n)).astype(np.float32)


def room_depth(seed, noise=0.002):
    """A corner of three planes with noise in inverse depth."""
    rng = np.random.default_rng(seed)
    planes = [
        [rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), -1.0],
        [-1.0, rng.uniform(-0.2, 0.2), rng.uniform(-0.8, -0.4)],
        [rng.uniform(-0.2, 0.2), -1.0, rng.uniform(-0.8, -0.4)],
    ]
    depths = np.stack([plane_depth(n, 1.5) for n in planes])
    inverse = 1 / np.where(depths > 0, depths, np.inf).min(axis=0)
    return (1 / (inverse + rng.normal(0, noise, inverse.shape))).astype(np.float32)


def loop_histogram(normals, N, alpha, pseudo_count):
    """Equations (6) to (9) as printed, one normal and one bin at a time."""
    bins = []
    for i in range(1, N + 1):
        theta = math.pi * i / N
        M = math.floor(2 * N * math.sin(theta) + 1e-9) + 1
        for j in range(1, M + 1):
            phi = 2 * math.pi * j / M
            v = (math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta))
            total = pseudo_count
            for n in normals:
                cosine = sum(a * b for a, b in zip(n, v, strict=True))
                if math.acos(min(1.0, max(-1.0, cosine))) <= alpha:
                    total += (cosine - math.cos(alpha)) / (1 - math.cos(alpha))
            bins.append(total)
    return np.array(bins) / sum(bins)


@pytest.mark.parametrize(("N", "alpha_deg"), [(4, 45.0), (6, 30.0)])
def test_weights_equal_the_loop(N, alpha_deg):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    alpha = math.radians(alpha_deg)
    fast = bin_weights(normals, bin_directions(N), alpha).sum(axis=0) + 0.5
    np.testing.assert_allclose(
        fast / fast.sum(), loop_histogram(normals, N, alpha, 0.5), atol=1e-12
    )


def test_number_of_bins_follows_equation_7():
    # N = 4: inclinations 45, 90, 135, 180 degrees, M = floor(8 sin) + 1 = 6, 9, 6, 1.
    assert len(bin_directions(4)) == 6 + 9 + 6 + 1
    np.testing.assert_allclose(np.linalg.norm(bin_directions(4), axis=1), 1)


def exact_divergence(current, previous, config=None, camera=CAMERA):
    """(10) from the normals of the library and exact weights."""
    config = config or DivergenceConfig.paper()
    normals = make_divergence(config, camera).normals(np.stack([current, previous]))
    histograms = []
    for frame in normals.astype(float):
        valid = frame[np.linalg.norm(frame, axis=2) > 0]
        weights = bin_weights(
            valid, bin_directions(config.inclinations), np.deg2rad(config.alpha_deg)
        )
        histograms.append(weights.sum(axis=0) + config.pseudo_count)
    return entropy(*histograms)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("config", [DivergenceConfig.paper(), DivergenceConfig()])
def test_divergence_is_that_of_exact_weights(seed, config):
    current = room_depth(seed)
    noise = np.random.default_rng(seed).normal(0, 3e-4, current.shape).astype(np.float32)
    for previous in (room_depth(seed + 100), current + noise):  # far apart, and nearly the same
        expected = exact_divergence(current, previous, config)
        found = make_divergence(config, CAMERA).histograms(
            np.zeros((2, *current.shape)), np.stack([current, previous])
        )
        assert entropy(*found.normals[:, 0]) == pytest.approx(expected, rel=1e-3, abs=1e-12)
    assert depth_divergence(current, previous, CAMERA) == pytest.approx(
        exact_divergence(current, previous), rel=1e-3, abs=0
    )


@pytest.mark.parametrize(("N", "alpha_deg"), [(2, 90.0), (4, 45.0), (8, 30.0), (32, 5.0)])
def test_no_bin_is_left_out_anywhere_on_the_sphere(N, alpha_deg):
    """Directions of all kinds: along the axes, on the folds of the map of directions, any."""
    rng = np.random.default_rng(N)
    axes = np.stack(np.meshgrid(*[[-1.0, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    directions = np.concatenate([rng.normal(size=(4000, 3)), axes[(axes != 0).any(axis=1)]])
    directions[:500, 2] *= 1e-3
    config = DivergenceConfig(inclinations=N, alpha_deg=alpha_deg)
    normals = np.zeros((1, *CAMERA.shape, 3), np.float32)
    normals.reshape(-1, 3)[: len(directions)] = directions
    nothing = np.zeros((1, *CAMERA.shape), np.float32)
    found = make_divergence(config, CAMERA).histograms(nothing, nothing, normals).normals[0, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    weights = bin_weights(directions, bin_directions(N), math.radians(alpha_deg))
    expected = weights.sum(axis=0) + config.pseudo_count
    np.testing.assert_allclose(found, expected / expected.sum(), rtol=1e-3)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(0.5, 4))
def test_normals_of_a_plane_are_exact(x, y, distance):
    normal = np.array([x, y, -1.0]) / math.sqrt(x * x + y * y + 1)
    depth = plane_depth(normal, distance)
    depth[(depth < 0) | (depth > 50)] = 0  # behind the camera, or near the plane's horizon
    normals = make_divergence(DivergenceConfig(), CAMERA).normals(depth[None])[0]
    found = np.linalg.norm(normals, axis=2) > 0
    assert found.sum() > 100
    np.testing.assert_allclose(normals[found], np.broadcast_to(normal, (found.sum(), 3)), atol=2e-3)


def test_normals_are_not_computed_across_an_edge():
    depth = np.full(CAMERA.shape, 2.0, dtype=np.float32)
    depth[:, 40:] = 1.0
    normals = make_divergence(DivergenceConfig(normal_reach_deg=0.0), CAMERA).normals(depth[None])[
        0
    ]
    assert not normals[30, [39, 40]].any()
    np.testing.assert_allclose(normals[30, [20, 60]], [[0, 0, -1], [0, 0, -1]], atol=1e-6)


def test_holes_have_no_normal_and_are_left_out():
    depth = plane_depth([0.2, 0.1, -1])
    holed = depth.copy()
    holed[20:30, 20:30] = 0
    assert depth_divergence(holed, depth, CAMERA) < 1e-3
    normals = make_divergence(DivergenceConfig(), CAMERA).normals(holed[None])[0]
    assert not normals[20:30, 20:30].any()


def test_no_valid_pixel_is_the_uniform_distribution():
    empty = np.zeros(CAMERA.shape, dtype=np.float32)
    assert depth_divergence(empty, empty, CAMERA) == 0
    plane = plane_depth([0, 0, -1])
    config = DivergenceConfig.paper()
    histogram = make_divergence(config, CAMERA).histograms(plane[None], plane[None]).normals[0, 0]
    uniform = np.ones_like(histogram)
    assert depth_divergence(plane, empty, CAMERA) == pytest.approx(entropy(histogram, uniform))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 50), st.integers(0, 50))
def test_is_non_negative_and_zero_for_the_same_frame(a, b):
    current, previous = room_depth(a), room_depth(b)
    divergence = depth_divergence(current, previous, CAMERA)
    assert 0 <= divergence < np.inf
    assert (divergence == 0) == (a == b)


def test_grows_with_the_angle():
    start = plane_depth([0, 0, -1])
    angles = np.deg2rad([2, 5, 10, 20])
    divergences = [
        depth_divergence(plane_depth([math.sin(a), 0, -math.cos(a)]), start, CAMERA) for a in angles
    ]
    assert divergences == sorted(divergences)


def test_frames_are_accepted():
    depth, other = room_depth(0), room_depth(1)
    color = np.zeros((*depth.shape, 3), dtype=np.uint8)
    frames = RGBDFrame(color, depth), RGBDFrame(color, other)
    assert depth_divergence(*frames, CAMERA) == depth_divergence(depth, other, CAMERA)


def with_pixel(value):
    depth = room_depth(0)
    depth[3, 4] = value
    return depth


@pytest.mark.parametrize(
    "bad",
    [
        with_pixel(np.nan),
        with_pixel(np.inf),
        with_pixel(-1.0),
        np.zeros((120, 160), dtype=np.float32),
        np.zeros(CAMERA.shape, dtype=np.uint16),
        np.zeros((60, 80, 1), dtype=np.float32),
        np.zeros(60, dtype=np.float32),
    ],
)
def test_bad_depth_is_refused(bad):
    with pytest.raises(InputError, match="depth"):
        depth_divergence(bad, room_depth(1), CAMERA)
    with pytest.raises(InputError, match="depth"):
        depth_divergence(room_depth(1), bad, CAMERA)


@pytest.mark.skipif(not LR_KT3.exists(), reason="needs the ICL-NUIM depth of lr kt3")
def test_real_frames_have_the_divergence_of_exact_weights():
    """Of one pair a table of weights, dithered, was 16 % off."""
    recording = open_recording(LR_KT3)
    depths = [frame.depth for frame in recording.every(10)[:4]]
    for current, previous in zip(depths[1:], depths[:-1], strict=True):
        expected = exact_divergence(current, previous, camera=recording.intrinsics)
        found = depth_divergence(current, previous, recording.intrinsics)
        assert found == pytest.approx(expected, rel=1e-3, abs=0)
