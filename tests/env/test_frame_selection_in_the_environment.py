"""The option ``frame_management`` of the environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.errors import InputError
from ms_slam_env.slam.frame_selection import DivergenceFilterConfig, SelectiveSlam

OPTIONS: dict[str, Any] = {
    "scene": "wall",
    "scene_seed": 0,
    "image_size": "80x60",
    "step_m": 0.03,
    "step_rad": 0.03,
}


def _play(env: ActiveSlamEnv, steps: int, seed: int = 0) -> list[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    return [env.step(rng.choice(np.flatnonzero(env.action_masks())))[-1] for _ in range(steps)]


def _assert_alike(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> None:
    for a, b in zip(first, second, strict=True):
        for name in a:
            np.testing.assert_equal(a[name], b[name])


def test_none_is_the_default_and_leaves_the_backend_alone():
    runs = []
    for options in ({}, {"frame_management": "none"}, {"frame_management": {"name": "none"}}):
        env = ActiveSlamEnv("free", **OPTIONS, **options)
        assert not isinstance(env.slam, SelectiveSlam)
        env.reset(seed=0)
        runs.append(_play(env, 3))
        assert env.episode.processed.all()
    _assert_alike(runs[0], runs[1])
    _assert_alike(runs[0], runs[2])


def test_a_dropped_frame_maps_nothing_and_has_a_predicted_pose():
    env = ActiveSlamEnv("free", **OPTIONS, frame_management={"name": "regular", "every": 2})
    env.reset(seed=0)
    forward = 7 * 5
    infos = [env.step(forward)[-1] for _ in range(4)]
    assert env.episode.processed.tolist() == [True, False, True, False, True]
    areas = [info["mapped_area"] for info in infos]
    assert areas[0] == areas[1] - infos[1]["reward_terms"]["new_surface"] / 1.0
    assert areas[2] == areas[1]
    assert all(info["tracking_ok"] for info in infos)
    # the third step is predicted from the motion of the first two, half as far
    assert infos[2]["pose_error"] < 0.01


@pytest.mark.parametrize("pose", ["kinematics", "slam-kinematics", "ground_truth"])
def test_known_and_guessed_poses_are_kept_for_dropped_frames(pose):
    options = {**OPTIONS, "scene": "table"}
    env = ActiveSlamEnv(
        "arm-kinematic",
        **options,
        pose=pose,
        frame_management={"name": "regular", "every": 3},
    )
    env.reset(seed=0)
    _play(env, 5)
    dropped = ~env.episode.processed
    assert dropped.any()
    estimate = env.episode.trajectory_estimate
    if pose == "ground_truth":
        np.testing.assert_array_equal(estimate, env.episode.trajectory_truth)
    if pose == "kinematics":
        np.testing.assert_array_equal(estimate[1:], env.episode.trajectory_kinematics[1:])
    if pose == "slam-kinematics":
        assert env.episode.pose_errors.max() < 0.02


def test_a_configuration_may_be_given_as_such():
    config = DivergenceFilterConfig(threshold=0.05)
    env = ActiveSlamEnv("free", **OPTIONS, frame_management=config)
    assert env.config.frame_management == config


@pytest.mark.parametrize(
    ("management", "message"),
    [
        (
            "sometimes",
            "frame_management.name 'sometimes'; valid choices: none, regular, divergence",
        ),
        ({"name": "regular", "evry": 2}, r"frame_management.evry.*valid choices: max_skip, pose"),
        ({"threshold": 1.0}, "frame_management.name.*valid choices: none"),
        (3, "frame_management = 3 must be 'none' or 'regular'"),
        ({"name": "budget", "budget_per_s": 1.0, "measured": True}, "must be reproducible"),
    ],
)
def test_bad_options_are_named(management, message):
    with pytest.raises(InputError, match=message):
        ActiveSlamEnv("free", **OPTIONS, frame_management=management)
