"""ATE and RPE against evo, alignment against a known motion."""

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, se3_exp
from ms_slam_env.metrics import (
    absolute_errors,
    ate_rmse,
    ate_statistics,
    path_length,
    relative_errors,
    rpe_rmse,
    rpe_statistics,
    umeyama,
)


def trajectories(seed, length=60):
    """A smooth true path and an estimate that drifts."""
    rng = np.random.default_rng(seed)
    truth, estimate = [np.eye(4)], [se3_exp(rng.normal(0, 0.5, 6))]
    for _ in range(length - 1):
        motion = se3_exp(rng.normal(0, [0.05] * 3 + [0.08] * 3))
        truth.append(truth[-1] @ motion)
        estimate.append(estimate[-1] @ motion @ se3_exp(rng.normal(0, 0.004, 6)))
    return np.array(estimate), np.array(truth)


def evo_error(metric, estimate, truth, align="none"):
    paths = [PosePath3D(poses_se3=list(poses)) for poses in (truth, estimate)]
    if align != "none":
        paths[1].align(paths[0], correct_scale=align == "sim3")
    metric.process_data(tuple(paths))
    return metric.get_all_statistics()


@pytest.mark.parametrize("align", ["se3", "sim3", "none"])
@pytest.mark.parametrize("seed", range(3))
def test_ate_equals_evo(align, seed):
    estimate, truth = trajectories(seed)
    expected = evo_error(evo_metrics.APE(), estimate, truth, align)
    found = ate_statistics(estimate, truth, align)
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(found, name) == pytest.approx(expected[name], abs=1e-9)
    assert ate_rmse(estimate, truth, align) == found.rmse


@pytest.mark.parametrize("delta", [1, 7])
@pytest.mark.parametrize(
    ("kind", "relation"),
    [
        ("translation", evo_metrics.PoseRelation.translation_part),
        ("rotation", evo_metrics.PoseRelation.rotation_angle_rad),
    ],
)
def test_rpe_equals_evo(delta, kind, relation):
    estimate, truth = trajectories(5)
    metric = evo_metrics.RPE(relation, delta=delta, all_pairs=True)
    expected = evo_error(metric, estimate, truth)
    found = rpe_statistics(estimate, truth, delta, kind)
    assert found.rmse == pytest.approx(expected["rmse"], abs=1e-9)
    assert found.max == pytest.approx(expected["max"], abs=1e-9)
    assert rpe_rmse(estimate, truth, delta, kind) == found.rmse


@given(st.integers(0, 1000), st.booleans())
def test_umeyama_finds_the_motion_that_was_applied(seed, with_scale):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3))
    T = se3_exp(rng.normal(size=6))
    scale = rng.uniform(0.2, 5) if with_scale else 1.0
    target = scale * source @ T[:3, :3].T + T[:3, 3]
    R, t, s = umeyama(source, target, with_scale)
    np.testing.assert_allclose(make_pose(R, t), T, atol=1e-9)
    assert s == pytest.approx(scale)


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_aligned_error_does_not_depend_on_the_world_frame(seed):
    estimate, truth = trajectories(seed, 20)
    moved = se3_exp(np.random.default_rng(seed).normal(size=6)) @ estimate
    assert ate_rmse(moved, truth) == pytest.approx(ate_rmse(estimate, truth), abs=1e-9)
    assert ate_rmse(estimate, truth) <= ate_rmse(estimate, truth, "none") + 1e-12


def test_positions_are_accepted():
    estimate, truth = trajectories(1)
    assert ate_rmse(estimate[:, :3, 3], truth[:, :3, 3]) == ate_rmse(estimate, truth)


def test_a_standing_camera_has_no_error():
    still = np.repeat(np.eye(4)[None], 5, axis=0)
    assert ate_rmse(still, still) == pytest.approx(0, abs=1e-12)
    assert rpe_rmse(still, still) == 0


def test_rotation_error_near_pi_is_exact():
    truth = np.repeat(np.eye(4)[None], 2, axis=0)
    estimate = truth.copy()
    estimate[1] = se3_exp([0, 0, 0, 0, 0, np.pi - 1e-6])
    assert relative_errors(estimate, truth, kind="rotation")[0] == pytest.approx(np.pi - 1e-6)


def test_path_length_of_a_square():
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]]
    assert path_length(corners) == 4


GOOD = np.repeat(np.eye(4)[None], 4, axis=0)


@pytest.mark.parametrize(
    ("estimate", "match"),
    [
        (GOOD[:3], "correspond"),
        (np.full_like(GOOD, np.nan), "finite"),
        (np.zeros((0, 4, 4)), "empty"),
        (np.zeros((4, 2)), r"\(4, 2\)"),
        (np.zeros((4, 3, 4)), r"\(4, 3, 4\)"),
    ],
)
def test_bad_trajectories_are_refused(estimate, match):
    for function in (ate_rmse, rpe_rmse):
        with pytest.raises(InputError, match=match):
            function(estimate, GOOD)


def test_bad_options_are_refused():
    with pytest.raises(InputError, match="sim3"):
        absolute_errors(GOOD, GOOD, align="se2")
    with pytest.raises(InputError, match="rotation"):
        relative_errors(GOOD, GOOD, kind="both")
    for delta in (0, -1, 1.5, True):
        with pytest.raises(InputError, match="delta"):
            relative_errors(GOOD, GOOD, delta=delta)
    with pytest.raises(InputError, match="at least 5"):
        relative_errors(GOOD, GOOD, delta=4)
    with pytest.raises(InputError, match="moves"):
        ate_rmse(GOOD, GOOD, align="sim3")
