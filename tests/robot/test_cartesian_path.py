"""The camera's way: ends, shape, speed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ms_slam_env.geometry import make_pose, relative_angle, so3_exp
from ms_slam_env.robot.arm.cartesian_path import CartesianPath, progress

vectors = arrays(np.float64, 3, elements=st.floats(-1.5, 1.5))
speeds = st.floats(0.01, 3)


@given(vectors, vectors, vectors, vectors, speeds, speeds)
def test_it_leads_from_start_to_end_in_a_line_about_one_axis(t0, r0, t1, r1, v, w):
    start, end = make_pose(so3_exp(r0), t0), make_pose(so3_exp(r1), t1)
    path = CartesianPath(start, end, v, w)
    times = np.linspace(0, path.duration_s, 40)
    poses = path.at(times)
    np.testing.assert_allclose(poses[0], start, atol=1e-9)
    np.testing.assert_allclose(poses[-1], end, atol=1e-9)
    whole = np.linalg.norm(t1 - t0)
    parts = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert parts.sum() == pytest.approx(whole, abs=1e-9)
    angles = [
        relative_angle(a, b) for a, b in zip(poses[:-1, :3, :3], poses[1:, :3, :3], strict=True)
    ]
    assert sum(angles) == pytest.approx(relative_angle(start[:3, :3], end[:3, :3]), abs=1e-6)


@given(vectors, vectors, speeds, speeds)
def test_the_slower_of_translation_and_rotation_runs_at_its_speed_and_none_faster(t, r, v, w):
    if np.linalg.norm(t) < 1e-3 and np.linalg.norm(r) < 1e-3:
        return
    path = CartesianPath(np.eye(4), make_pose(so3_exp(r), t), v, w)
    times = np.linspace(0, path.duration_s, 2001)
    poses = path.at(times)
    tick = times[1]
    fastest = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() / tick
    middle = poses[[999, 1001], :3, :3]
    turning = relative_angle(*middle) / (2 * tick)
    assert fastest <= v * (1 + 1e-6)
    assert turning <= w * (1 + 1e-5)
    assert max(fastest / v, turning / w) == pytest.approx(1, rel=1e-3)


def test_speed_is_a_trapezoid_with_ramps_of_a_fifth():
    share = np.linspace(0, 1, 5001)
    speed = np.gradient(progress(share), share)
    assert speed[0] == pytest.approx(0, abs=2e-3)
    assert speed[-1] == pytest.approx(0, abs=2e-3)
    cruise = (share > 0.201) & (share < 0.799)
    np.testing.assert_allclose(speed[cruise], 1.25, rtol=1e-9)
    ramp = (share > 0.001) & (share < 0.199)
    np.testing.assert_allclose(speed[ramp], 1.25 * share[ramp] / 0.2, rtol=1e-6)


def test_twelve_centimetres_at_a_fifth_of_a_metre_a_second():
    path = CartesianPath(np.eye(4), make_pose(np.eye(3), [0, 0, 0.12]), 0.2, 1.0)
    assert path.duration_s == pytest.approx(0.12 / 0.2 / 0.8)


def test_no_motion_takes_no_time():
    pose = make_pose(so3_exp([0.3, 0.2, 0.1]), [1, 2, 3])
    path = CartesianPath(pose, pose, 0.2, 1.0, least_duration_s=3.0)
    assert path.duration_s == 0
    np.testing.assert_allclose(path.at(np.array([0.0, 1.0])), [pose, pose], atol=1e-12)


def test_a_longer_duration_slows_it_down_and_a_shorter_one_does_not_hurry_it():
    end = make_pose(np.eye(3), [0.1, 0, 0])
    assert CartesianPath(np.eye(4), end, 0.2, 1.0, least_duration_s=5.0).duration_s == 5.0
    assert CartesianPath(np.eye(4), end, 0.2, 1.0, least_duration_s=0.1).duration_s == 0.625


def test_it_rests_before_the_start_and_after_the_end():
    end = make_pose(so3_exp([0, 0.2, 0]), [0.1, 0, 0])
    before, after = CartesianPath(np.eye(4), end, 0.2, 1.0).at(np.array([-1.0, 9.0]))
    np.testing.assert_allclose(before, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(after, end, atol=1e-12)
