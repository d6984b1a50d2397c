"""Map measures against Open3D's nearest neighbours and against closed forms."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import se3_exp, transform_points
from ms_slam_env.metrics import (
    f_score,
    icp,
    nearest_distances,
    precision,
    rcm,
    recall,
    rer,
    voxel_downsample,
)


def grid(nx, ny, spacing=0.05, z=0.0):
    x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    return np.stack([x * spacing, y * spacing, np.full_like(x, 1, dtype=float) * z], -1).reshape(
        -1, 3
    )


def box(seed, count=4000):
    """Points on the faces of a box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (count, 3)) * [2.0, 1.5, 1.0]
    face = rng.integers(0, 3, count)
    points[np.arange(count), face] = np.where(
        rng.random(count) < 0.5, 0.0, np.array([2.0, 1.5, 1.0])[face]
    )
    return points


def test_distances_equal_open3d():
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D does not import here: {error}")
    points, truth = box(0), box(1, 3000)
    clouds = [
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
        for cloud in (points, truth)
    ]
    to_truth = np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))
    to_map = np.asarray(clouds[1].compute_point_cloud_distance(clouds[0]))
    np.testing.assert_allclose(nearest_distances(points, truth), to_truth, atol=1e-12)
    threshold = 0.03
    p, r = (to_truth < threshold).mean(), (to_map < threshold).mean()
    assert precision(points, truth, threshold) == p
    assert recall(points, truth, threshold) == r
    assert rcm(points, truth, threshold) == r
    assert f_score(points, truth, threshold) == pytest.approx(2 * p * r / (p + r))
    assert rer(points, truth, "none") == pytest.approx(np.sqrt((to_truth**2).mean()))


def test_half_a_plane_at_a_distance():
    truth, points = grid(20, 20), grid(10, 20, z=0.03)
    assert precision(points, truth, 0.031) == 1
    assert precision(points, truth, 0.029) == 0
    assert recall(points, truth, 0.031) == 0.5
    assert f_score(points, truth, 0.031) == pytest.approx(2 / 3)
    assert f_score(points, truth, 0.029) == 0
    assert rer(points, truth, "none") == pytest.approx(0.03)


def test_icp_undoes_a_small_motion():
    truth = box(0)
    T = se3_exp([0.02, -0.01, 0.015, 0.02, -0.01, 0.015])
    moved = transform_points(np.linalg.inv(T), truth)
    np.testing.assert_allclose(icp(moved, truth), T, atol=2e-3)
    assert rer(moved, truth, "icp") < 0.2 * rer(moved, truth, "none")


@settings(max_examples=20)
@given(st.integers(0, 100), st.floats(0.02, 0.5))
@example(0, 2e-6)  # so many voxels that a number cannot say voxel and point
def test_thinning_leaves_the_first_point_of_the_input_in_each_voxel(seed, voxel_m):
    points = box(seed, 300) - 0.7
    firsts = {}
    for point in points:
        firsts.setdefault(tuple(np.floor(point / voxel_m).astype(int)), point)
    np.testing.assert_array_equal(voxel_downsample(points, voxel_m), list(firsts.values()))


GOOD = box(0, 50)


@pytest.mark.parametrize(
    ("bad", "match"),
    [
        (np.zeros((0, 3)), "empty"),
        (np.zeros((4, 2)), r"\(4, 2\)"),
        (np.zeros(3), r"\(3,\)"),
        (np.full((4, 3), np.nan), "finite"),
    ],
)
def test_bad_points_are_refused(bad, match):
    for pair in ((bad, GOOD), (GOOD, bad)):
        with pytest.raises(InputError, match=match):
            nearest_distances(*pair)
        with pytest.raises(InputError, match=match):
            rer(*pair)


def test_bad_options_are_refused():
    with pytest.raises(InputError, match="valid choices: none, icp, plane-icp, gicp"):
        rer(GOOD, GOOD, "sift")
    for threshold in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="threshold"):
            f_score(GOOD, GOOD, threshold)
    with pytest.raises(InputError, match="voxel_m"):
        voxel_downsample(GOOD, 0.0)
