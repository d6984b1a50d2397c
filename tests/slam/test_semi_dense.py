"""Semi-dense alignment: derivatives against differences, and known motions."""

import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import intensity_image, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, make_pose, se3_exp, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.odometry.semi_dense import (
    SemiDenseAligner,
    normal_equations,
)
from ms_slam_env.slam.shared.alignment_measures import DepthImage

CAMERA = xtion("160x120")
POSE = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])


def image(scene, pose, noise="none"):
    frame = RGBDSensor(scene, CAMERA, noise=noise).capture(pose, 0)
    return DepthImage(frame.depth, intensity_image(frame.color).astype(np.float32))


@pytest.fixture(scope="module")
def aligner():
    return SemiDenseAligner(CAMERA)


@pytest.fixture(scope="module")
def reference(box_scene: BoxScene, aligner):
    return aligner.prepare(image(box_scene, POSE))


def test_points_are_where_the_image_has_gradients_and_depth_has_none(reference):
    level = reference[0]
    assert 500 < len(level.points) < 0.7 * 160 * 120
    column, row = np.rint(CAMERA.project(level.points)).astype(int).T
    assert np.hypot(level.image[row, column, 1], level.image[row, column, 2]).min() > 5
    np.testing.assert_array_equal(level.image[row, column, 0], level.grey)
    slope = np.gradient(level.image[..., 0], axis=1)[1:-1, 1:-1]  # one more way to the same
    np.testing.assert_allclose(level.image[1:-1, 1:-1, 1], slope, atol=1e-4)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-0.01, 0.01), min_size=6, max_size=6))
def test_the_gradient_is_that_of_the_cost(box_scene, aligner, reference, xi):
    """Up to the gradients of the image, which are differences and not slopes of its pieces."""
    moved = POSE @ make_pose(so3_exp([0.0, 0.02, 0.0]), [0.02, 0.0, 0.0])
    frame = aligner.prepare(image(box_scene, moved))
    T = se3_exp(np.array(xi))
    H, g, cost = normal_equations(frame[0], reference[0], T)
    step = np.linalg.solve(H, g)
    length = 0.3 * step / max(1.0, np.linalg.norm(step) / 0.004)
    lower = normal_equations(frame[0], reference[0], se3_exp(length) @ T)[2]
    higher = normal_equations(frame[0], reference[0], se3_exp(-length) @ T)[2]
    assert lower < cost < higher
    np.testing.assert_allclose(H, H.T, rtol=1e-9)
    assert np.linalg.eigvalsh(H)[0] > 0


@pytest.mark.parametrize("noise", ["none", "kinect"])
def test_a_known_motion_is_found(box_scene, aligner, noise):
    motion = make_pose(so3_exp(np.radians([1.0, 2.5, -0.5])), [0.03, 0.01, 0.02])
    pair = [aligner.prepare(image(box_scene, T, noise)) for T in (POSE @ motion, POSE)]
    error = invert(motion) @ aligner.align(*pair)
    assert np.linalg.norm(error[:3, 3]) < 0.006
    assert np.abs(error[:3, :3] - np.eye(3)).max() < 0.003
    rest = aligner.align(pair[1], pair[1])
    np.testing.assert_allclose(rest, np.eye(4), atol=1e-9)


def test_a_blank_image_has_no_pose(aligner, reference):
    blank = DepthImage(np.full(CAMERA.shape, 2.0, np.float32), np.zeros(CAMERA.shape, np.float32))
    assert aligner.align(aligner.prepare(blank), aligner.prepare(blank)) is None


@pytest.mark.parametrize("size", ["80x60", "160x120"])
def test_as_a_backend_it_tracks(box_scene, size):
    K = xtion(size)
    sensor = RGBDSensor(box_scene, K, noise="kinect")
    backend = slam.make("odometry", K, aligner="semi-dense", max_surfels=60_000)
    backend.reset(POSE)
    step = make_pose(so3_exp([0, np.radians(-0.5), 0]), [0.01, 0, 0.002])
    pose = POSE
    for index in range(10):
        result = backend.track(sensor.capture(pose, index))
        assert result.tracking_ok, result.reason
        assert np.linalg.norm(result.T_world_camera[:3, 3] - pose[:3, 3]) < 0.015
        pose = pose @ step
    with pytest.raises(InputError, match="valid choices: opencv, semi-dense"):
        slam.make("odometry", K, aligner="lsd")
