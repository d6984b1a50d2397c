"""Lie group axioms, conversions and checks of poses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import (
    check_pose,
    hat,
    invert,
    look_at,
    make_pose,
    pose_from_quaternion,
    quaternion_from_pose,
    relative_angle,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transform_points,
)

vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))  # rotation angle below pi
twists = arrays(np.float64, 6, elements=st.floats(-1.8, 1.8))


@given(vectors, vectors)
def test_hat_is_the_cross_product(a, b):
    np.testing.assert_allclose(hat(a) @ b, np.cross(a, b), atol=1e-12)


@given(vectors)
def test_so3_exp_is_the_matrix_exponential(phi):
    np.testing.assert_allclose(so3_exp(phi), expm(hat(phi)), atol=1e-12)


@given(vectors)
def test_so3_log_undoes_exp(phi):
    back = so3_exp(so3_log(so3_exp(phi)))
    np.testing.assert_allclose(back, so3_exp(phi), atol=1e-12)


@given(arrays(np.float64, (5, 3), elements=st.floats(-1.8, 1.8)))
def test_so3_log_of_a_stack_is_that_of_each(phi):
    rotations = np.stack([so3_exp(one) for one in phi])
    np.testing.assert_array_equal(so3_log(rotations), [so3_log(R) for R in rotations])


@given(twists)
def test_se3_exp_is_the_matrix_exponential(xi):
    generator = np.zeros((4, 4))
    generator[:3, :3] = hat(xi[3:])
    generator[:3, 3] = xi[:3]
    np.testing.assert_allclose(se3_exp(xi), expm(generator), atol=1e-10)


@given(twists)
def test_se3_log_undoes_exp(xi):
    np.testing.assert_allclose(se3_exp(se3_log(se3_exp(xi))), se3_exp(xi), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 9e-6, 1.1e-5, 1e-3])
def test_small_angles_keep_their_digits(angle):
    xi = np.array([0.3, -0.2, 0.1, 0, angle, 0])
    np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, atol=1e-10)


@given(twists, twists)
def test_inverse_and_composition(a, b):
    A, B = se3_exp(a), se3_exp(b)
    np.testing.assert_allclose(invert(A) @ A, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(invert(A @ B), invert(B) @ invert(A), atol=1e-10)
    np.testing.assert_allclose(invert(np.stack([A, B]))[1], invert(B))
    check_pose(A @ B)


@given(twists, vectors)
def test_points_follow_the_pose(xi, point):
    T = se3_exp(xi)
    expected = (T @ [*point, 1.0])[:3]
    np.testing.assert_allclose(transform_points(T, point), expected, atol=1e-12)
    np.testing.assert_allclose(transform_points(T, [[point] * 2] * 3)[2, 1], expected, atol=1e-12)


@given(vectors, vectors)
def test_relative_angle(a, b):
    expected = (Rotation.from_rotvec(a).inv() * Rotation.from_rotvec(b)).magnitude()
    assert relative_angle(so3_exp(a), so3_exp(b)) == pytest.approx(expected, abs=1e-7)


@given(twists)
def test_quaternion_round_trip(xi):
    T = se3_exp(xi)
    q = quaternion_from_pose(T)
    assert np.linalg.norm(q) == pytest.approx(1)
    assert q[3] >= 0
    np.testing.assert_allclose(pose_from_quaternion(T[:3, 3], q), T, atol=1e-12)


def test_quaternion_order_is_xyzw():
    half = np.sqrt(0.5)
    T = pose_from_quaternion([0, 0, 0], [0, 0, half, half])  # 90 degrees about z
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@given(vectors, vectors)
def test_look_at_puts_the_target_on_the_axis(eye, target):
    distance = np.linalg.norm(target - eye)
    if distance < 1e-3:
        return
    T = check_pose(look_at(eye, target))
    np.testing.assert_allclose(
        transform_points(invert(T), target), [0, 0, distance], atol=1e-9 * max(1, distance) + 1e-9
    )
    assert T[2, 1] <= 1e-9  # the image's down axis never points up in the world


def test_look_at_along_up_and_at_itself():
    check_pose(look_at([0, 0, 2], [0, 0, 0]))
    with pytest.raises(InputError, match="differ"):
        look_at([1, 2, 3], [1, 2, 3])


@pytest.mark.parametrize(
    ("bad", "match"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "finite"),
        (np.diag([1, 1, -1, 1]), "rigid"),
        (np.diag([2, 2, 2, 1]), "rigid"),
        (np.diag([1, 1, 1, 2]), "rigid"),
    ],
)
def test_bad_poses_are_refused(bad, match):
    with pytest.raises(InputError, match=f"start.*{match}"):
        check_pose(bad, "start")


def test_make_pose():
    T = make_pose(np.eye(3), [1, 2, 3])
    np.testing.assert_array_equal(T[:3, 3], [1, 2, 3])
