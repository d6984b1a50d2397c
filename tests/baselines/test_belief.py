"""Belief of the pose: against Monte Carlo, closed forms and eigenvalues."""

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines.belief import (
    Belief,
    d_optimality,
    in_metres_and_radians,
    probability_within,
    propagated,
    trust,
)

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.geometry import invert, make_pose, se3_exp, se3_log, so3_exp, transform_points
from ms_slam_env.planning.trackability import SCALE, mean_depth, view_information

RNG = np.random.default_rng(0)
A = RNG.normal(size=(6, 6))
SIGMA = 1e-6 * (A @ A.T + np.eye(6))
NOTHING = np.zeros((1, 6, 6))


def test_a_pose_error_is_carried_to_the_frame_of_the_next_pose():
    """The same error of the world, written in the frame of a camera further on."""
    here = make_pose(so3_exp([0.1, -0.4, 0.2]), [1.0, 2.0, 0.5])
    there = make_pose(so3_exp([0.5, 0.3, -0.2]), [1.4, 1.5, 0.7])
    step = invert(here) @ there
    errors = RNG.multivariate_normal(np.zeros(6), SIGMA, 4000)
    carried = np.stack([se3_log(invert(step) @ se3_exp(e) @ step) for e in errors])
    drift = propagated(np.zeros((6, 6)) + 1e-15 * np.eye(6), [here, here], NOTHING, 2.0)
    found = propagated(SIGMA, [here, there], NOTHING, 2.0) - drift
    sampled = carried.T @ carried / len(errors)
    np.testing.assert_allclose(found, sampled, atol=0.1 * np.abs(sampled).max())


def test_what_a_view_tells_adds_to_what_was_known():
    H = np.linalg.inv(SIGMA)[None] * 3
    free = propagated(SIGMA, [np.eye(4)] * 2, NOTHING, 0.0)
    np.testing.assert_allclose(free, SIGMA, rtol=1e-6)
    told = propagated(SIGMA, [np.eye(4)] * 2, H, 0.0)
    np.testing.assert_allclose(told, SIGMA / 4, rtol=1e-6)
    twice = propagated(SIGMA, [np.eye(4)] * 3, np.concatenate([H, H]), 0.0)
    np.testing.assert_allclose(twice, SIGMA / 7, rtol=1e-6)


def test_d_optimality_is_the_geometric_mean_of_the_eigenvalues():
    expected = np.exp(np.log(np.linalg.eigvalsh(SIGMA)).mean())
    assert d_optimality(SIGMA) == pytest.approx(expected)
    assert d_optimality(np.zeros((6, 6))) == 0
    assert trust(SIGMA, np.linalg.inv(SIGMA) / 5) == pytest.approx(5)


@pytest.mark.parametrize("spread", [100, 1000, 4000])
def test_the_probability_to_land_in_place_is_that_of_samples(spread):
    covariance = spread * np.diag([1.0, 1, 1, 0.1, 0.1, 0.3]) * 1e-6
    point = np.array([[0, 0, 1.0]])
    errors = RNG.multivariate_normal(np.zeros(6), covariance, 4000)
    moved = np.concatenate([transform_points(se3_exp(e), point) - point for e in errors])
    sampled = (np.linalg.norm(moved, axis=1) < 0.05).mean()
    assert probability_within(covariance, 1.0) == pytest.approx(sampled, abs=0.04)


def test_information_in_metres_and_radians_is_that_of_the_view_with_its_length():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="living_room", scene_seed=3)
    env.reset(seed=3)
    world = env.unwrapped
    views = world.slam.predict(world.episode.T_world_camera_estimate[None], SCALE)
    points = (views.intrinsics.rays() * views.depth[0][..., None]).reshape(-1, 3)
    normals = views.normals[0].reshape(-1, 3)
    sigma = 0.0012 + 0.0019 * np.maximum(points[:, 2] - 0.4, 0) ** 2
    J = np.hstack([normals, np.cross(points, normals)]) / sigma[:, None]
    expected = J.T @ (J * (points[:, 2] > 0)[:, None])
    np.testing.assert_allclose(
        in_metres_and_radians(view_information(views), mean_depth(views))[0],
        expected,
        rtol=1e-3,
        atol=1e-4 * np.abs(expected).max(),
    )
    env.close()


def test_caution_changes_the_goal_and_none_weighs_correct_surface_alone():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="living_room", scene_seed=3)
    observation, info = env.reset(seed=3)
    planners = [Belief(env.unwrapped, 1, caution=caution) for caution in (0, 0, 1e6)]
    actions = []
    for planner in planners:
        planner.reset()
        actions.append(planner.act(observation, info))
        assert info["action_mask"][actions[-1]]
    np.testing.assert_array_equal(planners[0].goal, planners[1].goal)
    assert not np.allclose(planners[0].goal, planners[2].goal)
    env.close()
