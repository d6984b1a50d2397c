"""USME's measures of trajectories: robustness (9-10), initialisation (12-13), teams (14-20)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import hat, make_pose, se3_exp, se3_log, so3_exp
from ms_slam_env.geometry.point_clouds import umeyama
from ms_slam_env.metrics import (
    ate_rmse,
    initialisation,
    inter_robot_errors,
    inter_robot_rpe,
    local_scales,
    mean_path_length,
    rpe_rmse,
    task_time,
    team_ate,
    team_rpe,
    tracked_segments,
    tracking_robustness,
)
from ms_slam_env.metrics.robustness import similarity_log

TIMES = np.arange(60) / 10


def winding(count: int = 60, seed: int = 0) -> np.ndarray:
    """Poses along a curve in space."""
    rng = np.random.default_rng(seed)
    steps = [se3_exp(rng.normal(scale=[0.05] * 3 + [0.1] * 3)) for _ in range(count)]
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def straight(count: int = 60) -> np.ndarray:
    return np.stack([make_pose(np.eye(3), (0.1 * k, 0, 0)) for k in range(count)])


LOST = (TIMES >= 2) & (TIMES < 2.5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 100_000))
def test_similarity_log_inverts_expm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rho, phi, sigma = rng.normal(size=3), rng.normal(size=3), rng.normal()
    phi *= min(1.0, 3.0 / np.linalg.norm(phi))
    generator = np.zeros((4, 4))
    generator[:3, :3] = hat(phi) + sigma * np.eye(3)
    generator[:3, 3] = rho
    np.testing.assert_allclose(
        similarity_log(expm(generator)), [*rho, *phi, sigma], atol=1e-8, rtol=1e-8
    )


@pytest.mark.parametrize("poses", [winding(), straight()])
def test_pieces_that_moved_apart_are_found(poses: np.ndarray) -> None:
    offset = make_pose(so3_exp([0.0, 0.1, 0.2]), (0.3, 0.0, -0.1))
    estimate = poses.copy()
    estimate[TIMES >= 2.5] = np.linalg.inv(offset) @ poses[TIMES >= 2.5]
    found = tracking_robustness(estimate, poses, ~LOST)
    assert found.error == pytest.approx(np.linalg.norm(se3_log(offset)))
    assert found.rotation_rad == pytest.approx(np.hypot(0.1, 0.2))
    assert found.lost == pytest.approx(5 / 60)
    np.testing.assert_array_equal(found.segments, [[0, 20], [25, 60]])


def test_a_common_world_costs_nothing_and_neither_does_the_choice_of_it() -> None:
    poses, world = winding(), se3_exp([1, 2, 3, 0.3, 0.2, 0.1])
    assert tracking_robustness(poses, poses, ~LOST).error == pytest.approx(0, abs=1e-6)
    assert tracking_robustness(world @ poses, poses, ~LOST).error == pytest.approx(0, abs=1e-6)
    assert tracking_robustness(poses, poses, np.ones(60, bool)).error == 0  # one piece


@pytest.mark.parametrize(
    ("lost", "pieces", "share", "reason"),
    [
        (TIMES >= 0.3, 1, 57 / 60, "no piece follows the last loss"),  # held from then on
        (TIMES < 5.7, 1, 57 / 60, "no piece precedes the first loss"),
        (LOST | (TIMES >= 4), 2, 25 / 60, "no piece follows the last loss"),
        (LOST | (TIMES >= 5.75), 2, 7 / 60, "no piece follows the last loss"),
        (TIMES >= 0.2, 0, 1.0, "no piece of at least 3 frames was tracked"),
        (TIMES >= 0, 0, 1.0, "no piece of at least 3 frames was tracked"),
    ],
)
def test_a_loss_for_good_has_no_error_instead_of_none(
    lost: np.ndarray, pieces: int, share: float, reason: str
) -> None:
    poses = winding()
    held = np.maximum.accumulate(np.where(lost, 0, np.arange(60)))
    found = tracking_robustness(poses[held], poses, ~lost)
    parts = (found.error, found.translation_m, found.rotation_rad, found.log_scale)
    assert parts == (None,) * 4
    assert (len(found.segments), found.reason) == (pieces, reason)
    assert found.lost == pytest.approx(share)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_an_error_means_that_every_loss_was_joined(flags: list[bool]) -> None:
    ok, poses = np.array(flags), winding(len(flags))
    found = tracking_robustness(poses, poses, ok)
    inside = np.zeros(len(ok), bool)
    for first, end in found.segments:
        inside[first:end] = True
    joined = len(found.segments) > 0 and inside[0] and inside[-1]
    assert (found.error is not None) == joined == (found.reason == "")
    assert found.lost == pytest.approx(1 - inside.mean())


def test_no_poses_are_no_trajectory() -> None:
    with pytest.raises(InputError, match="estimate"):
        tracking_robustness(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), [])


def test_scale_that_changes_between_pieces() -> None:
    poses = winding()
    estimate = poses.copy()
    estimate[TIMES >= 2.5, :3, 3] *= 0.5
    found = tracking_robustness(estimate, poses, ~LOST, align="sim3")
    assert found.log_scale == pytest.approx(np.log(2))
    assert found.translation_m == pytest.approx(0, abs=1e-6)


def test_segments() -> None:
    flags = np.array([1, 1, 1, 0, 1, 1, 0, 0, 1, 1, 1, 1], dtype=bool)
    np.testing.assert_array_equal(tracked_segments(flags), [[0, 3], [8, 12]])
    np.testing.assert_array_equal(tracked_segments(flags, 1), [[0, 3], [4, 6], [8, 12]])


def test_scale_that_settles_after_two_seconds() -> None:
    truth = winding(200)[:, :3, 3]
    times = np.arange(200) / 20
    step = np.diff(truth, axis=0)
    growth = np.where(times[1:] < 2.0, 1 + (2.0 - times[1:]), 1.0)
    estimate = np.concatenate([truth[:1], truth[0] + np.cumsum(step * growth[:, None], axis=0)])
    found = initialisation(times, estimate / 1.25, truth, global_scale=1.0)
    assert found.time_s == pytest.approx(2.0, abs=0.5)
    assert found.scale == pytest.approx(1.25, rel=0.05)
    ratio = found.scale
    assert found.scale_error == pytest.approx((abs(1 / ratio - 1) + abs(ratio - 1)) / 2)
    scales = local_scales(times, truth / 3, truth, 1.0)
    np.testing.assert_allclose(scales, 3.0)
    at_once = initialisation(times, truth / 3, truth)
    assert (at_once.time_s, at_once.scale_error) == pytest.approx((0, 0))


@pytest.mark.filterwarnings("error")
def test_a_truth_that_stands_still_has_no_scale() -> None:
    poses, still = winding(), np.repeat(winding()[:1], 60, axis=0)
    assert initialisation(TIMES, poses, still, global_scale=1.0).time_s is None
    with pytest.raises(InputError, match="the truth stands still in frames 0 to 19"):
        tracking_robustness(poses, still, ~LOST, "sim3")


def test_scale_that_never_settles() -> None:
    truth = straight(100)[:, :3, 3]
    estimate = truth * np.linspace(1, 30, 100)[:, None] ** 2
    found = initialisation(np.arange(100) / 10, estimate, truth)
    assert (found.time_s, found.scale, found.scale_error) == (None, None, None)


def test_one_robot_is_judged_as_before_and_two_in_one_world() -> None:
    a, b = winding(60, 1), winding(40, 2)
    noisy = [
        T @ np.stack([se3_exp(x) for x in np.random.default_rng(k).normal(0, 0.01, (len(T), 6))])
        for k, T in enumerate((a, b))
    ]
    assert team_ate(noisy[:1], [a]).rmse == pytest.approx(ate_rmse(noisy[0], a))
    assert team_rpe(noisy[:1], [a]).rmse == pytest.approx(rpe_rmse(noisy[0], a))
    joined = np.concatenate(noisy)[:, :3, 3], np.concatenate([a, b])[:, :3, 3]
    assert team_ate(noisy, [a, b]).rmse == pytest.approx(ate_rmse(*joined))
    poses = np.concatenate(noisy), np.concatenate([a, b])
    assert team_ate(noisy, [a, b], kind="rotation").rmse == pytest.approx(
        ate_rmse(*poses, kind="rotation")
    )
    squares = 59 * rpe_rmse(noisy[0], a) ** 2 + 39 * rpe_rmse(noisy[1], b) ** 2
    assert team_rpe(noisy, [a, b]).rmse == pytest.approx(np.sqrt(squares / 98))
    seconds = [TIMES[: len(a)], TIMES[: len(b)] + 3.0]
    assert team_rpe(noisy, [a, b], 0.1, unit="s", times=seconds).rmse == pytest.approx(
        team_rpe(noisy, [a, b]).rmse
    )
    # Each alone fits its truth, but they disagree about the world.
    apart = [a, se3_exp([1, 0, 0, 0, 0, 0]) @ b]
    assert ate_rmse(apart[1], b) == pytest.approx(0, abs=1e-9)
    assert team_ate(apart, [a, b]).rmse > 0.2


def test_a_robot_in_the_frame_of_another() -> None:
    a, b, c = (winding(40, k) for k in (1, 2, 3))
    moved = se3_exp([0.0, 0.3, 0.4, 0, 0, 0])
    # Only the second robot is misplaced: by 0.5 m in the first one's frame and in the third's.
    errors = inter_robot_errors([a, moved @ b, c], [a, b, c])
    np.testing.assert_allclose(errors.reshape(3, 40)[[0, 2]], 0.5, atol=1e-9)
    np.testing.assert_allclose(errors.reshape(3, 40)[1], 0.0, atol=1e-9)
    # What all are off by together is no error between them, and each against itself is blind to it.
    assert inter_robot_rpe([moved @ a, moved @ b], [a, b]).rmse == pytest.approx(0, abs=1e-9)
    assert team_rpe([a, moved @ b], [a, b]).rmse == pytest.approx(0, abs=1e-9)
    turned = b @ se3_exp([0, 0, 0, 0, 0, 0.2])
    assert inter_robot_rpe([a, turned], [a, b], "rotation").rmse == pytest.approx(0.2)
    # By hand at one moment, with the definition written out.
    P = np.linalg.inv(a[5]) @ (moved @ turned)[5]
    E = np.linalg.inv(np.linalg.inv(a[5]) @ b[5]) @ P
    assert inter_robot_errors([a, moved @ turned], [a, b])[5] == pytest.approx(
        np.linalg.norm(E[:3, 3])
    )


def test_robots_are_compared_at_equal_times() -> None:
    a, b = winding(40, 1), winding(40, 2)
    times = [TIMES[:40], TIMES[10:50]]
    late = b.copy()
    late[:20] = se3_exp([1.0, 0, 0, 0, 0, 0]) @ late[:20]
    errors = inter_robot_errors([a, late], [a, b], times=times)
    np.testing.assert_allclose(errors, [1.0] * 20 + [0.0] * 10, atol=1e-9)
    assert len(inter_robot_errors([a, b[:7]], [a, b[:7]])) == 7
    with pytest.raises(InputError, match="no two robots overlap in time"):
        inter_robot_errors([a, b], [a, b], times=[TIMES[:40], TIMES[:40] + 100])
    with pytest.raises(InputError, match="at least 2"):
        inter_robot_errors([a], [a])


def test_time_and_way_of_a_team() -> None:
    assert task_time([[3.0, 4.0, 9.0], [1.0, 5.0]]) == 8.0
    assert mean_path_length([straight(11), straight(31)]) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: tracking_robustness(winding(), winding(), np.ones(60)), "bool"),
        (lambda: tracking_robustness(winding(), winding(9), np.ones(60, bool)), "correspond"),
        (lambda: tracking_robustness(winding(), winding(), ~LOST, align="x"), "se3, sim3"),
        (lambda: tracking_robustness(winding(), winding(), ~LOST, lever_m=-1), "lever_m"),
        (lambda: initialisation(TIMES[::-1], winding(), winding()), "increase"),
        (lambda: initialisation(TIMES, winding(), winding(), threshold=0), "threshold"),
        (lambda: local_scales(TIMES, winding(), winding(), 0), "window_s"),
        (lambda: team_ate([], []), "no robot"),
        (lambda: team_rpe([winding()], []), "1 estimates but 0"),
        (
            lambda: team_rpe([winding()], [winding()], 1.0, unit="s", times=[]),
            "1 true trajectories but times of 0",
        ),
        (lambda: team_ate([winding()], [winding()], kind="both"), "valid choices: translation"),
        (lambda: team_ate([winding()], [winding(9)]), "must correspond"),
        (lambda: task_time([[1.0, 1.0]]), "robot 0"),
        (lambda: mean_path_length([]), "no robot"),
    ],
)
def test_bad_input(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.3])
def test_scales_of_all_windows_are_those_of_each_to_the_bit(jitter: float) -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(1 / 30 + jitter * rng.random(300))
    truth = np.cumsum(rng.normal(0, 0.01, (300, 3)), axis=0)
    estimate = truth / 3 + rng.normal(0, 1e-3, (300, 3))
    estimate[100:160] = estimate[100]
    found = local_scales(times, estimate, truth, 1.0)
    for k, t in enumerate(times):
        near = (times >= t - 0.5) & (times <= t + 0.5)
        moves = near.sum() >= 3 and np.ptp(estimate[near], axis=0).max() > 1e-9
        want = umeyama(estimate[near], truth[near], with_scale=True)[2] if moves else np.nan
        assert found[k] == want or (np.isnan(found[k]) and not want > 0)
    assert np.isnan(found).any()
