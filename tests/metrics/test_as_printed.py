"""USME's equations to the letter: by hand, and where they differ from what tools compute."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, se3_exp, so3_exp
from ms_slam_env.metrics import absolute_errors, ate_rmse, relative_errors
from ms_slam_env.metrics.relative import printed_ate, printed_errors, printed_relative_errors


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
