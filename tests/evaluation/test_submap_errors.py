"""Errors of submaps: each aligned by itself, and those joined to the first."""

import numpy as np
import pytest

from ms_slam_env.evaluation.submap_errors import paths_by_submap, submap_errors
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.metrics import ate_rmse

RNG = np.random.default_rng(0)
TRUTH = np.stack([make_pose(so3_exp(RNG.normal(size=3)), RNG.normal(size=3)) for _ in range(40)])
NUMBERS = np.array([0] * 15 + [-1] * 5 + [2] * 18 + [3] * 2)


def _estimate(noise_m: float) -> np.ndarray:
    poses = TRUTH.copy()
    poses[:, :3, 3] += noise_m * RNG.normal(size=(40, 3))
    shifted = make_pose(so3_exp([0.2, 0.1, -0.3]), [1.0, 2.0, 3.0])
    poses[NUMBERS == 2] = shifted @ poses[NUMBERS == 2]
    return poses


def test_submaps_in_wrong_places_are_right_each_by_itself():
    found = submap_errors(_estimate(0.0), TRUTH, NUMBERS)
    assert found["submap_ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert found["joined_ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert ate_rmse(_estimate(0.0), TRUTH) > 0.1


def test_the_error_of_all_is_the_mean_over_frames_of_those_with_three_poses():
    poses = _estimate(0.02)
    found = submap_errors(poses, TRUTH, NUMBERS)
    parts = {n: ate_rmse(poses[n == NUMBERS], TRUTH[n == NUMBERS]) for n in (0, 2)}
    mean = np.sqrt((15 * parts[0] ** 2 + 18 * parts[2] ** 2) / 33)
    assert found == pytest.approx({"joined_ate_m": parts[0], "submap_ate_m": mean})


def test_nothing_is_said_where_nothing_was_tracked():
    assert submap_errors(TRUTH, TRUTH, np.full(40, -1)) == {}


def test_paths_are_broken_where_the_camera_was_in_another_submap():
    paths = paths_by_submap(TRUTH, NUMBERS)
    assert list(paths) == ["submap 0", "submap 2", "submap 3"]
    np.testing.assert_array_equal(paths["submap 2"][20:38], TRUTH[20:38, :3, 3])
    assert np.isnan(paths["submap 2"][:20]).all()
    assert np.isnan(paths["submap 2"][38:]).all()
