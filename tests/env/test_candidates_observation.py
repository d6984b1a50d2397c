"""The observation `candidates`: number by number what the planners themselves look at."""

import dataclasses
import math

import numpy as np
import pytest
from ms_slam_baselines.belief import d_optimality
from ms_slam_baselines.greedy import GreedyDivergence, distance_to_targets
from small_env import FREE, small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.planning import OccupancyGrid, expected_gain, view_information
from ms_slam_env.planning.candidates import NAMES
from ms_slam_env.planning.trackability import SCALE, slip_risk
from ms_slam_env.planning.view_goals import best_goal

STATE = 37


def make(env_id=FREE, observation="candidates", **options):
    return small_env(env_id, observation=observation, **options)


def numbers_of(observation):
    """Name to the numbers (n,) of the candidates."""
    rows = observation[STATE:].reshape(-1, len(NAMES)).astype(np.float64)
    return dict(zip(NAMES, rows.T, strict=True))


@pytest.fixture(scope="module")
def moment():
    """An environment after a few steps and what it showed."""
    env = make()
    env.reset(seed=0)
    for action in (14, 3, 41):
        observation, *_ = env.step(action)
    return env, observation


@pytest.fixture(scope="module")
def seen(moment):
    """Poses and views of here and of the candidates, predicted as the planners do."""
    world = moment[0].unwrapped
    here = world.episode.T_world_camera_estimate
    poses = np.concatenate([here[None], world.candidate_poses()])
    return poses, world.slam.predict(poses, SCALE)


def test_divergences_are_those_of_the_greedy_planner(moment):
    world, numbers = moment[0].unwrapped, numbers_of(moment[1])
    targets = world.config.targets
    expected = GreedyDivergence(world).predicted() / targets.maxima
    shown = np.stack([numbers["intensity_divergence"], numbers["depth_divergence"]], axis=1)
    np.testing.assert_allclose(shown, np.clip(expected, 0, 5), rtol=1e-5, atol=1e-6)
    assert np.ptp(shown, axis=0).min() > 0.1
    unit = dataclasses.replace(targets, M_I=1, M_D=1)  # whose nats are units of M
    far = [distance_to_targets(*row, unit) for row in expected]
    np.testing.assert_allclose(numbers["criterion"], np.clip(far, 0, 5), rtol=1e-5, atol=1e-6)


def test_overlap_nearness_information_and_risk_are_those_of_the_other_planners(moment, seen):
    (poses, views), numbers = seen, numbers_of(moment[1])
    pixels = views.depth[0].size
    np.testing.assert_allclose(numbers["overlap"], (views.depth[1:] > 0).mean(axis=(1, 2)), 1e-6)
    near = np.count_nonzero((views.depth > 0) & (views.depth < 0.5), axis=(1, 2))[1:] / pixels
    np.testing.assert_allclose(numbers["near"], near, rtol=1e-6)
    H = view_information(views)[1:]
    dopt = [math.log1p(d_optimality(one) / pixels) for one in H]
    np.testing.assert_allclose(numbers["d_optimality"], dopt, rtol=1e-5)
    weakest = [math.log1p(np.linalg.eigvalsh(one).min() / pixels) for one in H]
    np.testing.assert_allclose(numbers["weakest"], weakest, rtol=1e-4)
    np.testing.assert_allclose(numbers["slip_risk"], slip_risk(views, poses)[1:], rtol=1e-4)


def test_the_risk_of_a_motion_of_several_frames_is_that_of_one():
    env = make(frames_per_action=3)
    observation, _ = env.reset(seed=0)
    world = env.unwrapped
    here = world.episode.T_world_camera_estimate
    poses = np.concatenate([here[None], world.candidate_poses()])
    views = world.slam.predict(poses, SCALE)
    found = numbers_of(observation)["slip_risk"]
    np.testing.assert_allclose(found, slip_risk(views, poses, 3)[1:], rtol=1e-4)
    assert (found <= slip_risk(views, poses)[1:] + 1e-6).all()


def test_gain_and_the_way_to_the_goal_are_those_of_the_occupancy_grid(moment):
    env, observation = moment
    world, numbers = env.unwrapped, numbers_of(observation)
    grid, here = world.episode.occupancy, world.episode.T_world_camera_estimate
    poses, steps = world.candidate_poses(), (world.config.step_m, world.config.step_rad)
    gain = expected_gain(grid, poses, world.intrinsics, (8, 6))
    np.testing.assert_allclose(numbers["gain"], gain / gain.max(), rtol=1e-5)
    assert observation[28] == pytest.approx(gain.max(), rel=1e-5)
    goal = best_goal(grid, here, world.intrinsics, steps)
    metres = [np.linalg.norm(p[:3, 3] - goal[:3, 3]) / steps[0] for p in [here, *poses]]
    turns = [relative_angle(p[:3, :3], goal[:3, :3]) / steps[1] for p in [here, *poses]]
    for name, away in (("goal_translation", metres), ("goal_rotation", turns)):
        nearer = np.clip(away[0] - np.array(away[1:]), -3, 3)
        np.testing.assert_allclose(numbers[name], nearer, atol=1e-5)
    np.testing.assert_allclose(observation[29:32], (invert(here) @ goal)[:3, 3] / 5, atol=1e-6)
    np.testing.assert_allclose(observation[32:35], (invert(here) @ goal)[:3, 2], atol=1e-6)
    assert observation[35:37] == pytest.approx([metres[0] / 10, turns[0] / 10], rel=1e-4)


def test_the_motions_are_those_of_the_actions(moment):
    env, observation = moment
    numbers = numbers_of(observation)
    np.testing.assert_array_equal(numbers["permitted"], env.unwrapped.action_masks())
    forward, yaw = 7 * 5, 6
    assert numbers["step_z"][forward] == pytest.approx(1, abs=1e-5)
    assert abs(numbers["turn_y"][yaw]) == pytest.approx(1, abs=1e-4)
    assert all(numbers[name][0] == pytest.approx(0, abs=1e-6) for name in NAMES[-6:])


def test_a_goal_is_in_free_space_and_stays_while_nothing_better_is_found():
    grid = OccupancyGrid()
    grid.log_odds = -np.ones((30, 30, 12), np.int8)
    grid.blanks = np.zeros_like(grid.log_odds)
    here, camera = np.eye(4), make().unwrapped.intrinsics
    here[:3, 3] = 1.5, 1.5, 0.6
    goal = best_goal(grid, here, camera, (0.12, 0.2))
    np.testing.assert_allclose(goal[:3, :3] @ goal[:3, :3].T, np.eye(3), atol=1e-12)
    assert (grid.log_odds[tuple(grid.cells_of(goal[:3, 3]))] < 0).all()
    assert expected_gain(grid, goal[None], camera) > expected_gain(grid, here[None], camera)
    grid.log_odds[0, 0, 0] = 3  # in a corner, out of its sight
    moved = here.copy()
    moved[0, 3] += 0.02
    np.testing.assert_array_equal(best_goal(grid, moved, camera, (0.12, 0.2))[:3, :3], goal[:3, :3])


@pytest.mark.parametrize(
    ("env_id", "motions", "more"),
    [
        (FREE, 49, 0),
        ("MSActiveSLAM-FixedTranslation-v0", 7, 0),
        ("MSActiveSLAM-Adaptive-v0", 49, 3),
    ],
)
def test_every_environment_has_it(env_id, motions, more):
    options = {"embodiment": "free"} if more else {}
    env = make(env_id, **options)
    assert env.observation_space.shape == (STATE + motions * len(NAMES) + more,)
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert env.observation_space.contains(env.step(env.action_space.sample() * 0)[0])


def test_steps_of_no_length_are_finite():
    env = make(step_m=0.0)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
