"""ATE of position and orientation against evo; alignments, and those that cannot be had."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, se3_exp, so3_exp
from ms_slam_env.metrics import (
    absolute_errors,
    ate_rmse,
    ate_statistics,
    find_alignment,
    path_length,
    rpe_rmse,
    tracked_errors,
    umeyama,
)
from ms_slam_env.metrics.trajectory import ALIGNMENTS

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
RELATIONS = {
    "translation": evo_metrics.PoseRelation.translation_part,
    "rotation": evo_metrics.PoseRelation.rotation_angle_rad,
}


def drifting(seed: int, length: int = 50, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """An estimate that drifts, in a world and a scale of its own, and the truth."""
    rng = np.random.default_rng(seed)
    truth, estimate = [np.eye(4)], [se3_exp(rng.normal(0, 1.5, 6))]
    for _ in range(length - 1):
        motion = se3_exp(rng.normal(0, [0.05] * 3 + [0.2] * 3))
        truth.append(truth[-1] @ motion)
        estimate.append(estimate[-1] @ motion @ se3_exp(rng.normal(0, 0.01, 6)))
    result = np.array(estimate)
    result[:, :3, 3] *= scale
    return result, np.array(truth)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    length=st.integers(5, 60),
    scale=st.floats(0.2, 4.0),
    align=st.sampled_from(["se3", "sim3", "origin", "none"]),
    first=st.none() | st.integers(4, 80),
    kind=st.sampled_from(list(RELATIONS)),
)
def test_equals_evo(
    seed: int, length: int, scale: float, align: str, first: int | None, kind: str
) -> None:
    estimate, truth = drifting(seed, length, scale)
    paths = [PosePath3D(poses_se3=list(poses)) for poses in (truth, estimate)]
    if align in ("origin", "none"):
        first = None
    if align == "origin":
        paths[1].align_origin(paths[0])
        found_alignment = find_alignment(estimate, truth, align)
        np.testing.assert_allclose(found_alignment.poses(estimate), paths[1].poses_se3, atol=1e-9)
    elif align != "none":
        few = -1 if first is None else min(first, length)
        R, t, s = paths[1].align(paths[0], correct_scale=align == "sim3", n=few)
        found_alignment = find_alignment(estimate, truth, align, first)
        assert found_alignment.scale == pytest.approx(s, abs=1e-9)
        np.testing.assert_allclose(found_alignment.R, R, atol=1e-9)
        np.testing.assert_allclose(found_alignment.t, t, atol=1e-9)
        np.testing.assert_allclose(found_alignment.poses(estimate), paths[1].poses_se3, atol=1e-9)
    metric = evo_metrics.APE(RELATIONS[kind])
    metric.process_data(tuple(paths))
    expected = metric.get_all_statistics()
    found = ate_statistics(estimate, truth, align, kind, first)
    for name in STATISTICS:
        assert getattr(found, name) == pytest.approx(expected[name], abs=1e-9)
    assert ate_rmse(estimate, truth, align, kind, first) == found.rmse
    errors = absolute_errors(estimate, truth, align, kind, first)
    np.testing.assert_allclose(errors, metric.error, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), first=st.none() | st.integers(3, 30))
def test_yaw_alignment_is_the_best_that_a_search_finds(seed: int, first: int | None) -> None:
    estimate, truth = drifting(seed, 30)
    moved = make_pose(so3_exp([0, 0, seed % 7 - 3.0]), [1, -2, 3]) @ estimate
    found = find_alignment(moved, truth, "yaw", first)
    assert (found.scale, found.unique) == (1.0, True)
    np.testing.assert_allclose(found.R[2], [0, 0, 1], atol=1e-15)
    own, true = moved[:first, :3, 3], truth[:first, :3, 3]

    def residuals(x: np.ndarray) -> np.ndarray:
        return ((own @ so3_exp([0, 0, x[0]]).T + x[1:]) - true).ravel()

    starts = ([angle, 0.0, 0.0, 0.0] for angle in (-2.0, 0.0, 2.0))
    searched = min((least_squares(residuals, x) for x in starts), key=lambda best: best.cost)
    errors = absolute_errors(moved, truth, "yaw", first=first)[:first]
    assert 0.5 * (errors**2).sum() == pytest.approx(searched.cost, rel=1e-6)


def test_yaw_alignment_leaves_a_tilt_that_se3_takes_away() -> None:
    _, truth = drifting(2)
    tilted = make_pose(so3_exp([0.1, 0, 0]), [0, 0, 1]) @ truth
    turned = make_pose(so3_exp([0, 0, 2.5]), [0, 0, 1]) @ truth
    assert ate_rmse(tilted, truth) < 1e-9 < 1e-2 < ate_rmse(tilted, truth, "yaw")
    assert ate_rmse(turned, truth, "yaw", "rotation") < 1e-9
    upright = truth.copy()
    upright[:, :2, 3] = 0.0
    assert not find_alignment(upright, upright, "yaw").unique


def test_a_rotated_camera_errs_by_that_angle_alone() -> None:
    _, truth = drifting(3)
    estimate = truth @ make_pose(se3_exp([0, 0, 0, 0, 0.25, 0])[:3, :3], [0, 0, 0])
    assert ate_rmse(estimate, truth) == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(absolute_errors(estimate, truth, kind="rotation"), 0.25, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_errors_do_not_depend_on_the_world_frame(seed: int) -> None:
    estimate, truth = drifting(seed, 20)
    moved = se3_exp(np.random.default_rng(seed).normal(size=6)) @ estimate
    for kind in RELATIONS:
        np.testing.assert_allclose(
            absolute_errors(moved, truth, kind=kind),
            absolute_errors(estimate, truth, kind=kind),
            atol=1e-9,
        )
    T = invert(truth[3])
    np.testing.assert_allclose(
        absolute_errors(T @ estimate, T @ truth, "none", "rotation"),
        absolute_errors(estimate, truth, "none", "rotation"),
        atol=1e-9,
    )


def test_a_straight_path_leaves_orientation_open() -> None:
    line = np.repeat(np.eye(4)[None], 6, axis=0)
    line[:, :3, 3] = np.linspace(0, 1, 6)[:, None] * [0.3, -0.7, 0.2]
    assert not find_alignment(line, line).unique
    assert ate_rmse(line, line) == pytest.approx(0, abs=1e-12)
    assert ate_rmse(line, line, "none", "rotation") == 0
    with pytest.raises(InputError, match="on a line"):
        ate_rmse(line, line, "se3", "rotation")
    for few in (line[:1], line[:2]):
        with pytest.raises(InputError, match="on a line"):
            ate_rmse(few, few, "sim3" if len(few) == 2 else "se3", "rotation")


def test_tracked_frames_are_aligned_by_themselves() -> None:
    estimate, truth = drifting(5)
    tracked = np.arange(len(truth)) % 3 != 0
    held = estimate.copy()
    held[~tracked, :3, 3] = estimate[0, :3, 3]
    found = tracked_errors(held, truth, tracked)
    assert found == {
        "ate_tracked_m": ate_rmse(estimate[tracked], truth[tracked]),
        "tracked_share": tracked.mean(),
    }
    assert ate_rmse(held, truth) > 2 * found["ate_tracked_m"]
    with pytest.raises(InputError, match=r"tracked of shape \(3,\)"):
        tracked_errors(held, truth, np.ones(3))
    few = tracked_errors(held, truth, np.arange(len(truth)) == 3)
    assert few == {"ate_tracked_m": None, "tracked_share": 0.02}


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


def test_positions_are_accepted():
    estimate, truth = drifting(1)
    assert ate_rmse(estimate[:, :3, 3], truth[:, :3, 3]) == ate_rmse(estimate, truth)


def test_a_standing_camera_has_no_error():
    still = np.repeat(np.eye(4)[None], 5, axis=0)
    assert ate_rmse(still, still) == pytest.approx(0, abs=1e-12)
    assert rpe_rmse(still, still) == 0


def test_path_length_of_a_square():
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]]
    assert path_length(corners) == 4


WRONG = st.one_of(
    st.just(np.zeros((0, 4, 4))),
    st.just([]),
    st.just("poses"),
    st.just([[1.0, 2.0, 3.0], [4.0]]),
    st.builds(
        lambda shape: np.zeros(shape),
        st.lists(st.integers(1, 5), max_size=4).filter(
            lambda s: not (len(s) == 3 and s[1:] == [4, 4])
        ),
    ),
    st.builds(
        lambda value, k: np.where(np.arange(6 * 16).reshape(6, 4, 4) == k, value, 0.5),
        st.sampled_from([np.nan, np.inf, -np.inf]),
        st.sampled_from([3, 7, 16 + 3, 95 - 4]),
    ),
)


@settings(max_examples=80, deadline=None)
@given(wrong=WRONG, align=st.sampled_from(ALIGNMENTS), swap=st.booleans())
def test_wrong_poses_are_one_clear_error(wrong: object, align: str, swap: bool) -> None:
    good = drifting(0, 6)[1]
    pair = (good, wrong) if swap else (wrong, good)
    for measure in (lambda: ate_rmse(*pair, align, "rotation"), lambda: rpe_rmse(*pair)):
        with pytest.raises(InputError) as caught:
            measure()
        assert "\n" not in str(caught.value)


def test_wrong_options() -> None:
    estimate, truth = drifting(0, 6)
    with pytest.raises(InputError, match="valid choices: se3, sim3, yaw, origin, none"):
        ate_rmse(estimate, truth, "affine")
    with pytest.raises(InputError, match="valid choices: translation, rotation"):
        ate_rmse(estimate, truth, kind="both")
    with pytest.raises(InputError, match="must correspond"):
        ate_rmse(estimate[1:], truth)
    with pytest.raises(InputError, match="moves"):
        ate_rmse(truth[:1].repeat(4, axis=0), truth[:4], align="sim3")
    with pytest.raises(InputError, match="se3, sim3, yaw can align by the first poses, not origin"):
        ate_rmse(estimate, truth, "origin", first=3)
    with pytest.raises(InputError, match="first must be an integer >= 1"):
        ate_rmse(estimate, truth, first=0)
    with pytest.raises(InputError, match=r"\(N, 4, 4\) poses"):
        ate_rmse(estimate[:, :3, 3], truth[:, :3, 3], "origin")
    with pytest.raises(InputError, match=r"\(N, 4, 4\) poses"):
        ate_rmse(estimate[:, :3, 3], truth, kind="rotation")
