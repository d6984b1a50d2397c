"""Registration of clouds against Open3D and against the motion that was applied."""

from __future__ import annotations

import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, se3_exp, transform_points
from ms_slam_env.geometry.point_clouds import IndexedCloud
from ms_slam_env.metrics import completion, nearest_distances, register_clouds, rer

CORNER = np.array([2.0, 1.5, 1.0])
METHODS = ("icp", "plane-icp", "gicp")


def room(seed: int, count: int) -> np.ndarray:
    """Points on the walls of a box, with a ledge, so that no symmetry is left."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (count, 3)) * CORNER
    face = rng.integers(0, 3, count)
    side = rng.random(count) < 0.5
    points[np.arange(count), face] = np.where(side, 0.0, CORNER[face])
    ledge = points[:, 0] < 0.4
    points[ledge, 2] = np.minimum(points[ledge, 2], 0.6)
    return points


def waves(seed: int, count: int) -> np.ndarray:
    """Points on a smooth surface: without edges, all searches end in the same place."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    return np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], axis=1)


def motion(seed: int) -> np.ndarray:
    return se3_exp(np.random.default_rng(seed).normal(0, 0.01, 6))


@pytest.fixture(scope="module")
def open3d() -> types.ModuleType:
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D cannot run here: {error}")
    return module


def open3d_registration(open3d, method: str, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """As `register_clouds`, with the normals that it uses: Open3D's differ a little."""
    import small_gicp

    algorithms = open3d.pipelines.registration
    clouds = []
    for points in (source, target):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        own = small_gicp.PointCloud(points)
        small_gicp.estimate_normals_covariances(own, small_gicp.KdTree(own), 20, 1)
        cloud.normals = open3d.utility.Vector3dVector(own.normals()[:, :3])
        cloud.covariances = open3d.utility.Matrix3dVector(
            np.array([cov[:3, :3] for cov in own.covs()])
        )
        clouds.append(cloud)
    rule = algorithms.ICPConvergenceCriteria(1e-12, 1e-12, 300)
    if method == "gicp":
        estimation = algorithms.TransformationEstimationForGeneralizedICP()
        found = algorithms.registration_generalized_icp(*clouds, 0.1, np.eye(4), estimation, rule)
    else:
        estimation = {
            "icp": algorithms.TransformationEstimationPointToPoint(),
            "plane-icp": algorithms.TransformationEstimationPointToPlane(),
        }[method]
        found = algorithms.registration_icp(*clouds, 0.1, np.eye(4), estimation, rule)
    return found.transformation


@pytest.mark.parametrize("method", METHODS)
def test_equals_open3d(open3d, method: str) -> None:
    target = waves(0, 8000)
    source = transform_points(invert(motion(3)), waves(1, 4000))
    source = source + np.random.default_rng(2).normal(0, 0.003, source.shape)
    expected = open3d_registration(open3d, method, source, target)
    found = register_clouds(source, target, method, cutoff_m=0.1)
    np.testing.assert_allclose(found.T_target_source, expected, atol=1e-8)
    assert found.share > 0.95


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(METHODS))
def test_undoes_the_motion_that_was_applied(seed: int, method: str) -> None:
    target, T = room(seed, 3000), motion(seed)
    source = transform_points(invert(T), target)
    found = register_clouds(source, target, method, cutoff_m=0.2)
    np.testing.assert_allclose(found.T_target_source, T, atol=3e-4)
    assert (found.pairs, found.share) == (3000, 1.0)


def test_twice_the_same_to_the_last_bit() -> None:
    target = room(0, 3000)
    source = transform_points(motion(1), room(1, 3000))
    for method in METHODS:
        first, second = (register_clouds(source, target, method) for _ in range(2))
        np.testing.assert_array_equal(first.T_target_source, second.T_target_source)


def test_a_cloud_with_its_trees_serves_again_and_again() -> None:
    points, target = transform_points(motion(1), room(1, 3000)), room(0, 3000)
    kept = IndexedCloud(target)
    for method in (*METHODS, *METHODS):
        first, second = (register_clouds(points, to, method) for to in (target, kept))
        np.testing.assert_array_equal(first.T_target_source, second.T_target_source)
    assert rer(points, kept) == rer(points, target)
    np.testing.assert_array_equal(
        nearest_distances(points, kept), nearest_distances(points, target)
    )
    np.testing.assert_array_equal(kept, target)
    assert (len(kept), kept.tree, kept.gicp) == (3000, kept.tree, kept.gicp)
    with pytest.raises(InputError, match="truth is empty"):
        nearest_distances(points, np.empty((0, 3)))


def test_nothing_near_leaves_the_cloud_where_it_is() -> None:
    target = room(0, 500)
    for method in METHODS:
        found = register_clouds(target + 50.0, target, method, cutoff_m=0.1)
        assert (found.pairs, found.share, found.converged) == (0, 0.0, False)
        np.testing.assert_array_equal(found.T_target_source, np.eye(4))
    none = register_clouds(target + 50.0, target, "none")
    np.testing.assert_array_equal(none.T_target_source, np.eye(4))


def test_only_so_many_points_are_matched() -> None:
    target = room(0, 3000)
    found = register_clouds(target, target, "icp", max_points=100)
    assert found.pairs == 100


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "sift"}, "valid choices: none, icp, plane-icp, gicp"),
        ({"cutoff_m": 0.0}, "cutoff_m"),
        ({"cutoff_m": np.nan}, "cutoff_m"),
        ({"source": room(0, 9), "method": "gicp"}, "gicp needs at least 20 points"),
        ({"source": np.zeros((0, 3))}, "source is empty"),
        ({"target": np.full((4, 3), np.inf)}, "target holds values that are not finite"),
        ({"target": np.zeros((4, 2))}, r"target must be \(N, 3\), got \(4, 2\)"),
        ({"target": "cloud"}, "target is not an array of numbers"),
    ],
)
def test_bad_input_is_one_clear_error(options: dict, message: str) -> None:
    arguments = {"source": room(0, 50), "target": room(1, 50)} | options
    with pytest.raises(InputError, match=message):
        register_clouds(**arguments)


def test_completion_of_half_a_plane() -> None:
    grid = 0.1 * np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    half = grid[grid[:, 0] < 0.95] + [0.0, 0.0, 0.02]
    found = completion(half, grid)
    missing = np.hypot(0.1 * np.arange(1, 11), 0.02)  # distances beyond the edge, column by column
    assert found.accuracy_cm == pytest.approx(2.0)
    assert found.completion_cm == pytest.approx(100 * np.mean([*[0.02] * 10, *missing]))
    assert found.completion_ratio == 0.5
    assert completion(half, grid, 0.01).completion_ratio == 0


def test_completion_equals_open3d(open3d) -> None:
    points, truth = room(0, 3000), room(1, 2000)
    clouds = [
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
        for cloud in (points, truth)
    ]
    accuracy = np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))
    to_map = np.asarray(clouds[1].compute_point_cloud_distance(clouds[0]))
    found = completion(points, truth)
    assert found.accuracy_cm == pytest.approx(100 * accuracy.mean(), abs=1e-9)
    assert found.completion_cm == pytest.approx(100 * to_map.mean(), abs=1e-9)
    assert found.completion_ratio == (to_map < 0.05).mean()


def test_completion_refuses_bad_input() -> None:
    with pytest.raises(InputError, match="threshold"):
        completion(room(0, 5), room(0, 5), np.nan)
    with pytest.raises(InputError, match="is empty"):
        completion(np.zeros((0, 3)), room(0, 5))
