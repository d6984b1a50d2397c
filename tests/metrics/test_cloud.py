"""Outliers, noise ratio, spacing and distances of point clouds against Open3D, SciPy, grids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist, directed_hausdorff
from scipy.stats import norm

from ms_slam_env.errors import InputError
from ms_slam_env.metrics import (
    cloud_distance,
    hausdorff_distance,
    noise_distance,
    noise_ratio,
    point_spacing,
    statistical_inliers,
)


def cloud(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize(("neighbours", "std_ratio"), [(5, 1.0), (20, 2.0), (8, 0.5)])
def test_outliers_are_those_of_open3d(neighbours: int, std_ratio: float) -> None:
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D cannot run here: {error}")
    points = np.concatenate([cloud(0), 10 * cloud(1, 30)])
    reference = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    _, kept = reference.remove_statistical_outlier(neighbours, std_ratio)
    found = np.flatnonzero(statistical_inliers(points, neighbours, std_ratio))
    np.testing.assert_array_equal(found, np.sort(kept))
    assert 0 < len(found) < len(points)


def test_two_sided_removal_drops_what_lies_too_close_as_well() -> None:
    rng = np.random.default_rng(5)
    clump = rng.normal([20.0, 0, 0], 1e-3, size=(40, 3))
    points = np.concatenate([cloud(0), clump, [[23.0, 0, 0]]])
    d = np.sort(cdist(points, points), axis=1)[:, :10].mean(axis=1)  # the slow, obvious way
    low, high = (d.mean() + sign * 0.3 * d.std(ddof=1) for sign in (-1, 1))
    assert low > 0
    found = statistical_inliers(points, 10, 0.3, two_sided=True)
    np.testing.assert_array_equal(found, (d > low) & (d < high))
    one_sided = statistical_inliers(points, 10, 0.3)
    assert one_sided[400:440].all()
    assert not found[400:440].any()
    assert not one_sided[440]


def test_noise_ratio_is_the_share_of_points_off_the_surface() -> None:
    plane = 0.01 * np.stack(np.meshgrid(np.arange(300.0), np.arange(300.0), [0.0]), -1)
    plane = plane.reshape(-1, 3)
    assert noise_distance(plane, 0.02) == pytest.approx(3 * np.hypot(0.02, 0.01))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0.5, 2.5, (100_000, 2)), rng.normal(0, 0.05, 100_000)])
    limit = noise_distance(plane, 0.01)
    # The nearest sample is up to a grid cell's half aside, so the share lies between two bounds.
    low, high = (2 * norm.sf(np.sqrt(limit**2 - s**2) / 0.05) for s in (0.0, 0.005 * np.sqrt(2)))
    assert low - 0.005 < noise_ratio(points, plane, 0.01) < high + 0.005
    assert noise_ratio(np.concatenate([plane, plane[:100] + 5.0]), plane) == 100 / 90_100


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 0.03))
def test_noise_ratio_never_falls_with_the_noise(seed: int, sensor_m: float) -> None:
    rng = np.random.default_rng(seed)
    plane = np.column_stack([rng.uniform(0, 2, (5000, 2)), np.zeros(5000)])
    error = np.column_stack([np.zeros((5000, 2)), rng.standard_normal(5000)])
    ratios = [noise_ratio(plane + s * error, plane, sensor_m) for s in (0.0, 0.005, 0.05, 0.3)]
    assert ratios == sorted(ratios)
    assert ratios[0] == 0
    assert ratios[3] > 0.5


def test_spacing_of_a_grid() -> None:
    grid = 0.25 * np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    assert point_spacing(grid) == pytest.approx(0.25)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(1, 60))
def test_hausdorff_is_scipys(seed: int, n: int, m: int) -> None:
    a, b = cloud(seed, n), cloud(seed + 1, m)
    there, back = directed_hausdorff(a, b)[0], directed_hausdorff(b, a)[0]
    assert hausdorff_distance(a, b, symmetric=False) == pytest.approx(there)
    assert hausdorff_distance(a, b) == pytest.approx(max(there, back))
    assert hausdorff_distance(a, b) == pytest.approx(hausdorff_distance(b, a))
    assert hausdorff_distance(a, a) == 0


def test_distance_of_a_shifted_plane() -> None:
    plane = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    found = cloud_distance(plane + np.array([0, 0, 0.3]), plane)
    assert (found.mean, found.rms, found.max) == pytest.approx((0.3, 0.3, 0.3))
    assert found.std == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: statistical_inliers(cloud(0), 1), "neighbours must be an integer >= 2"),
        (lambda: statistical_inliers(cloud(0, 5), 20), "20 neighbours need as many points, got 5"),
        (lambda: statistical_inliers(cloud(0), 5, 0.0), "std_ratio"),
        (lambda: point_spacing(cloud(0, 1)), "at least 2"),
        (lambda: hausdorff_distance(np.zeros((0, 3)), cloud(0)), "points is empty"),
        (lambda: cloud_distance(np.full((3, 3), np.nan), cloud(0)), "not finite"),
        (lambda: noise_ratio(np.zeros((9, 2)), cloud(0)), r"must be \(N, 3\)"),
        (lambda: noise_ratio(cloud(0), cloud(0, 1)), "at least 2"),
        (lambda: noise_ratio(cloud(0), cloud(1), -1.0), "sigma_m must be finite and >= 0 m"),
    ],
)
def test_bad_input(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
