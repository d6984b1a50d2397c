"""RPE over frames, metres and seconds against evo and a plain loop; drift; Zhang and Scaramuzza."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import filters
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, se3_exp, so3_exp
from ms_slam_env.metrics import (
    absolute_errors,
    ate_rmse,
    drifts,
    equal_pieces,
    pose_pairs,
    relative_errors,
    rpe_rmse,
    rpe_statistics,
)
from ms_slam_env.metrics.relative import printed_ate, printed_errors, printed_relative_errors

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
RELATIONS = {
    "translation": evo_metrics.PoseRelation.translation_part,
    "rotation": evo_metrics.PoseRelation.rotation_angle_rad,
}


def walk(seed: int, length: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A path with steps of 0 to some 0.2 m, and an estimate that drifts."""
    rng = np.random.default_rng(seed)
    truth, estimate = [np.eye(4)], [np.eye(4)]
    for _ in range(length - 1):
        motion = se3_exp(rng.normal(0, [0.08] * 3 + [0.1] * 3) * rng.uniform(0, 1.5))
        truth.append(truth[-1] @ motion)
        estimate.append(estimate[-1] @ motion @ se3_exp(rng.normal(0, 0.01, 6)))
    return np.array(estimate), np.array(truth)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    choice=st.sampled_from([("frames", 1), ("frames", 5), ("m", 0.3), ("m", 1.0)]),
    kind=st.sampled_from(list(RELATIONS)),
    every=st.booleans(),
    tolerance=st.sampled_from([0.1, 0.3]),
)
def test_equals_evo(
    seed: int, choice: tuple[str, float], kind: str, every: bool, tolerance: float
) -> None:
    unit, delta = choice
    estimate, truth = walk(seed)
    metric = evo_metrics.RPE(
        RELATIONS[kind],
        delta=delta,
        delta_unit=Unit.frames if unit == "frames" else Unit.meters,
        rel_delta_tol=tolerance,
        all_pairs=every,
        pairs_from_reference=True,
    )
    metric.process_data(tuple(PosePath3D(poses_se3=list(poses)) for poses in (truth, estimate)))
    expected = metric.get_all_statistics()
    options = {"unit": unit, "pairs": "all" if every else "consecutive", "tolerance": tolerance}
    found = rpe_statistics(estimate, truth, delta, kind, **options)
    for name in STATISTICS:
        assert getattr(found, name) == pytest.approx(expected[name], abs=1e-9)
    assert rpe_rmse(estimate, truth, delta, kind, **options) == found.rmse
    errors = relative_errors(estimate, truth, delta, kind, **options)
    np.testing.assert_allclose(errors, metric.error, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10_000), st.floats(0.05, 3.0), st.booleans(), st.sampled_from([0.0, 0.05, 0.4])
)
def test_seconds_are_paired_as_metres_of_a_path_at_one_metre_a_second(
    seed: int, delta: float, every: bool, tolerance: float
) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.3, 40))
    line = np.repeat(np.eye(4)[None], 40, axis=0)
    line[:, 0, 3] = times
    expected = filters.filter_pairs_by_path(list(line), delta, tolerance * delta, every)
    pairs = "all" if every else "consecutive"
    still = np.repeat(np.eye(4)[None], 40, axis=0)
    if not expected:
        with pytest.raises(InputError, match="no two poses are"):
            pose_pairs(still, delta, "s", times, pairs, tolerance)
        return
    found = pose_pairs(still, delta, "s", times, pairs, tolerance)
    np.testing.assert_array_equal(found, expected)


def test_rotation_error_near_pi_is_exact():
    truth = np.repeat(np.eye(4)[None], 2, axis=0)
    estimate = truth.copy()
    estimate[1] = se3_exp([0, 0, 0, 0, 0, np.pi - 1e-6])
    assert relative_errors(estimate, truth, kind="rotation")[0] == pytest.approx(np.pi - 1e-6)


def test_a_second_of_a_drift_in_time() -> None:
    times = np.arange(30) / 10
    truth = np.repeat(np.eye(4)[None], 30, axis=0)
    estimate = truth.copy()
    estimate[:, 1, 3] = 0.02 * times
    errors = relative_errors(estimate, truth, 1.0, unit="s", times=times)
    np.testing.assert_allclose(errors, np.full(20, 0.02), atol=1e-12)
    consecutive = pose_pairs(truth, 1.0, "s", times, "consecutive")
    np.testing.assert_array_equal(consecutive, [[0, 10], [10, 20]])
    for step in (0.1, 0.3, 1 / 3, 0.7):
        times = np.arange(301) * step + 1.3e3
        found = pose_pairs(
            np.repeat(np.eye(4)[None], 301, axis=0), 10 * step, "s", times, "consecutive"
        )
        np.testing.assert_array_equal(found[:, 1], np.arange(10, 301, 10))


def slow_drift(
    estimate: np.ndarray, truth: np.ndarray, length: float, every: int
) -> tuple[list[float], list[float]]:
    """As the KITTI benchmark describes it, in plain loops."""
    position = truth[:, :3, 3]
    along = [0.0]
    for k in range(1, len(truth)):
        along.append(along[-1] + float(np.linalg.norm(position[k] - position[k - 1])))
    translation, rotation = [], []
    for first in range(0, len(truth), every):
        last = next((k for k in range(first, len(truth)) if along[k] > along[first] + length), None)
        if last is None:
            continue
        true_motion = np.linalg.inv(truth[first]) @ truth[last]
        error = np.linalg.inv(np.linalg.inv(estimate[first]) @ estimate[last]) @ true_motion
        translation.append(float(np.linalg.norm(error[:3, 3])) / length)
        cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
        rotation.append(float(np.arccos(cosine)) / length)
    return translation, rotation


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 7))
def test_drift_by_length_equals_a_plain_loop(seed: int, every: int) -> None:
    estimate, truth = walk(seed, 80)
    found = drifts(estimate, truth, [0.5, 1.5, 100.0], every)
    assert [drift.length_m for drift in found] == [0.5, 1.5]
    for drift in found:
        translation, rotation = slow_drift(estimate, truth, drift.length_m, every)
        assert drift.segments == len(translation)
        assert drift.translation.mean == pytest.approx(np.mean(translation), abs=1e-9)
        assert drift.translation.max == pytest.approx(np.max(translation), abs=1e-9)
        assert drift.rotation_rad_m.median == pytest.approx(np.median(rotation), abs=1e-7)


def test_a_delta_below_the_rounding_of_times_ends() -> None:
    poses = np.repeat(np.eye(4)[None], 5, axis=0)
    poses[:, 0, 3] = np.arange(5)
    pairs = pose_pairs(poses, 1e-12, "m", pairs="consecutive")
    np.testing.assert_array_equal(pairs, [[0, 1], [1, 2], [2, 3], [3, 4]])


def test_drift_of_a_wrong_scale_is_that_share() -> None:
    truth = np.repeat(np.eye(4)[None], 101, axis=0)
    truth[:, 0, 3] = 0.1 * np.arange(101)
    estimate = truth.copy()
    estimate[:, 0, 3] *= 1.02
    found = drifts(estimate, truth)
    np.testing.assert_allclose([drift.length_m for drift in found], [1, 2, 3, 4, 5])
    for drift in found:
        # A sub-trajectory ends at the first pose beyond its length, one step of 0.1 m at most.
        assert 0.02 <= drift.translation.mean <= 0.02 * (1 + 0.1 / drift.length_m) + 1e-9
        assert drift.rotation_rad_m.max == pytest.approx(0, abs=1e-9)
    still = np.repeat(np.eye(4)[None], 5, axis=0)
    assert drifts(still, still) == []


@given(st.integers(1, 500), st.integers(1, 60))
def test_equal_pieces_cover_all_poses_once(count: int, pieces: int) -> None:
    if pieces > count:
        with pytest.raises(InputError, match="cannot be cut"):
            equal_pieces(count, pieces)
        return
    bounds = equal_pieces(count, pieces)
    covered = [k for first, end in bounds for k in range(first, end)]
    assert covered == list(range(count))
    assert np.ptp(bounds[:, 1] - bounds[:, 0]) <= 1


STILL = np.repeat(np.eye(4)[None], 5, axis=0)
TIMES = np.arange(5.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"delta": 0}, "integer >= 1"),
        ({"delta": 5}, "at least 6 poses, got 5"),
        ({"delta": 0.5}, "integer >= 1"),
        ({"delta": True}, "integer >= 1"),
        ({"delta": 1.0, "unit": "m"}, "no two poses are 1 m apart: the trajectory spans 0 m"),
        ({"delta": -1.0, "unit": "m"}, "finite and > 0 m"),
        ({"delta": np.nan, "unit": "s", "times": TIMES}, "finite and > 0 s"),
        ({"delta": "1", "unit": "m"}, "finite and > 0 m"),
        ({"delta": 9.0, "unit": "s", "times": TIMES}, "spans 4 s"),
        ({"unit": "s"}, "needs the times"),
        ({"unit": "s", "times": TIMES[1:]}, r"times must be \(5,\)"),
        ({"unit": "s", "times": TIMES[::-1]}, "increase"),
        ({"unit": "s", "times": np.full(5, np.nan)}, "increase"),
        ({"unit": "deg"}, "valid choices: frames, m, s"),
        ({"pairs": "some"}, "valid choices: all, consecutive"),
        ({"tolerance": -0.1}, "tolerance"),
        ({"kind": "both"}, "valid choices: translation, rotation"),
    ],
)
def test_wrong_options_are_one_clear_error(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        relative_errors(STILL, STILL, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: drifts(STILL, STILL[1:]), "correspond"),
        (lambda: drifts(STILL, STILL, [0.0]), "> 0 m"),
        (lambda: drifts(STILL, STILL, [1.0], every=0), "every"),
        (lambda: equal_pieces(5, 0), "segments must be an integer >= 1"),
        (lambda: equal_pieces(5, True), "segments must be an integer >= 1"),
    ],
)
def test_wrong_segments_are_one_clear_error(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def winding(count: int = 50, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = [se3_exp(rng.normal(size=6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3_exp(rng.normal(scale=[0.05] * 3 + [0.1] * 3)))
    return np.stack(poses)


def noisy(poses: np.ndarray, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([T @ se3_exp(rng.normal(scale=0.02, size=6)) for T in poses])


def test_equations_one_and_two_written_out() -> None:
    truth, estimate = winding(), noisy(winding())
    squares = angles = 0.0
    for T, E in zip(truth, estimate, strict=True):
        dR = T[:3, :3] @ E[:3, :3].T
        squares += np.sum((T[:3, 3] - dR @ E[:3, 3]) ** 2)
        angles += np.arccos((np.trace(dR) - 1) / 2) ** 2
    assert printed_ate(estimate, truth, "none").rmse == pytest.approx(np.sqrt(squares / 50))
    assert printed_ate(estimate, truth, "none", "rotation").rmse == pytest.approx(
        np.sqrt(angles / 50)
    )


def test_angles_are_ours_and_positions_too_where_orientations_are_right() -> None:
    truth, estimate = winding(), noisy(winding())
    for align in ("none", "se3"):
        np.testing.assert_allclose(
            printed_errors(estimate, truth, align, "rotation"),
            absolute_errors(estimate, truth, align, "rotation"),
            atol=1e-9,
        )
    shifted = truth.copy()
    shifted[:, :3, 3] += np.random.default_rng(3).normal(size=(50, 3))
    np.testing.assert_allclose(
        printed_errors(shifted, truth, "none"), absolute_errors(shifted, truth, "none")
    )


def test_as_printed_the_error_depends_on_where_the_world_begins() -> None:
    truth, estimate = winding(), noisy(winding())
    away = make_pose(np.eye(3), [100.0, 0, 0])
    assert ate_rmse(away @ estimate, away @ truth, "none") == pytest.approx(
        ate_rmse(estimate, truth, "none")
    )
    here, there = (printed_ate(T @ estimate, T @ truth, "none").rmse for T in (np.eye(4), away))
    assert there > 10 * here
    # An orientation off by 0.1 rad about z, 100 m from the origin: 2 sin(0.05) 100 m.
    turned = away @ make_pose(so3_exp([0, 0, 0.1]), [0, 0, 0])
    assert printed_errors(turned[None], away[None], "none") == pytest.approx(200 * np.sin(0.05))


def test_the_set_of_equation_five_written_out() -> None:
    truth, estimate = winding(), noisy(winding())
    found = printed_relative_errors(estimate, truth, delta=3)
    assert len(found) == 47
    laid = truth[4] @ np.linalg.inv(estimate[4]) @ estimate[7]
    dR = truth[7][:3, :3] @ laid[:3, :3].T
    assert found[4] == pytest.approx(np.linalg.norm(truth[7][:3, 3] - dR @ laid[:3, 3]))
    np.testing.assert_allclose(
        printed_relative_errors(estimate, truth, delta=3, kind="rotation"),
        relative_errors(estimate, truth, 3, "rotation"),
        atol=1e-9,
    )
    with pytest.raises(InputError, match="valid choices: translation"):
        printed_relative_errors(estimate, truth, delta=3, kind="both")
