"""Backlash, vibration and sensor errors against their definitions."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal

from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError
from ms_slam_env.robot.arm import ArmConfig, ArmNoise
from ms_slam_env.robot.arm.dynamics import VIBRATION_PERIOD_S, Imperfections, play

PERFECT = ArmNoise(0, 0, 0, 0, 0, 0)
SHARE = np.array([1.0, 0.5, 0.25])


def imperfections(noise, seed=0):
    return Imperfections(noise, SHARE, np.random.default_rng(seed))


@given(
    arrays(np.float64, st.tuples(st.integers(1, 40), st.just(2)), elements=st.floats(-1, 1)),
    st.floats(0, 0.5),
    st.floats(-1, 1),
)
def test_play_is_the_textbook_recursion(x, half_width, start):
    y, expected = np.full(2, start), []
    for one in x:
        y = np.minimum(np.maximum(y, one - half_width), one + half_width)
        expected.append(y)
    assert_array_equal(play(x, np.full(2, start), half_width), expected)


def test_a_there_and_back_motion_draws_a_hysteresis_loop():
    x = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 101)])[:, None]
    y = play(x, np.zeros(1), 0.05)[:, 0]
    going, back = y[:101], y[101:][::-1]
    assert_allclose(going[10:], x[10:101, 0] - 0.05)
    assert_allclose(back[:90], x[:90, 0] + 0.05)
    assert (y[101:110] == y[100]).all()  # nothing moves until the play is crossed
    assert_array_equal(y, play(np.repeat(x, 3, axis=0), np.zeros(1), 0.05)[::3, 0])  # at any speed


def test_motions_in_parts_are_one_motion():
    noise = ArmNoise(backlash_rad=0.1)
    x = np.cumsum(np.random.default_rng(1).normal(0, 0.03, (60, 3)), axis=0)
    whole, parts = imperfections(noise), imperfections(noise)
    expected = whole.link_angles(x)
    assert_array_equal(expected, np.concatenate([parts.link_angles(p) for p in np.split(x, 4)]))
    assert np.abs(expected - x).max() <= 0.05 + 1e-12


def test_all_zero_is_exact():
    exact = imperfections(PERFECT)
    q = np.random.default_rng(0).normal(size=(9, 3))
    assert_array_equal(exact.link_angles(q), q)
    assert_array_equal(exact.readings(q), q)
    assert_array_equal(exact.torques(np.ones((9, 3)), 0.005), np.zeros((9, 3)))
    assert_array_equal(exact.T_camera_assumed, np.eye(4))


def test_readings_have_an_offset_an_episode_and_noise_a_reading():
    drawn = ArmNoise(joint_offset_rad=0.01, encoder_rad=0.001)
    offsets = []
    for seed in range(300):
        errors = imperfections(drawn, seed).readings(np.zeros((200, 3)))
        assert_allclose(errors.std(axis=0), 0.001, rtol=0.35)
        offsets.append(errors.mean(axis=0))
    assert_allclose(np.std(offsets), 0.01, rtol=0.1)
    assert abs(np.mean(offsets)) < 0.001


def test_hand_eye_errors_have_their_size():
    errors = [imperfections(ArmNoise(), seed).T_camera_assumed for seed in range(300)]
    assert_allclose(np.std([T[:3, 3] for T in errors]), ArmNoise().hand_eye_m, rtol=0.1)
    assert_allclose(np.linalg.det([T[:3, :3] for T in errors]), 1)


def test_vibration_grows_with_speed_and_rests_with_the_joint():
    speed = np.repeat([[0.0, 0.5, -1.0]], 40_000, axis=0)
    torque = imperfections(ArmNoise(vibration_nm=2.0)).torques(speed, 0.005)
    assert_allclose(torque.std(axis=0), 2.0 * np.abs(speed[0]) * SHARE, rtol=0.03)
    steps = round(VIBRATION_PERIOD_S / 0.005)
    held = torque.reshape(-1, steps, 3)
    assert (held == held[:, :1]).all()
    assert (np.diff(held[:, 0, 2]) != 0).all()


@pytest.mark.parametrize("moved", [False, True])
def test_it_goes_on_from_a_saved_state(moved):
    first, second = imperfections(ArmNoise(), 1), imperfections(ArmNoise(), 2)
    q = np.cumsum(np.full((20, 3), 0.01), axis=0)
    if moved:
        first.link_angles(q)
    second.set_state(first.get_state())
    for make in (lambda i: i.readings(q), lambda i: i.link_angles(-q)):
        assert_array_equal(make(first), make(second))
    assert_array_equal(first.torques(q, 0.005), second.torques(q, 0.005))
    assert_array_equal(first.T_camera_assumed, second.T_camera_assumed)


def test_noise_has_names():
    perfect = from_dict(ArmConfig, {"noise": "none"}).noise
    assert set(dataclasses.asdict(perfect).values()) == {0.0}
    assert from_dict(ArmConfig, {"noise": "default"}) == ArmConfig()
    flawless = imperfections(perfect)
    q = np.linspace(0, 1, 12).reshape(4, 3)
    assert_array_equal(flawless.link_angles(q), q)
    assert_array_equal(flawless.readings(q), q)
    assert_array_equal(flawless.T_camera_assumed, np.eye(4))
    assert not flawless.torques(np.ones((4, 3)), 0.01).any()
    with pytest.raises(InputError, match="must be an ArmNoise"):
        ArmConfig(noise="none")
