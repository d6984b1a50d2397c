"""Permitted maxima: what is expected against a loop, what is learnt against quantiles."""

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines import GreedyLimited

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.divergence import make_divergence
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.planning.trackability import SCALE
from ms_slam_env.planning.view_goals import distance_in_steps


@pytest.fixture(scope="module")
def env():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="living_room", scene_seed=3)
    yield env
    env.close()


def play(env, planner, steps, seed=3):
    observation, info = env.reset(seed=seed)
    planner.reset()
    beyond = []
    for _ in range(steps):
        action = planner.act(observation, info)
        assert info["action_mask"][action]
        observation, _, _, _, info = env.step(action)
        beyond.append((info["divergence"] > env.unwrapped.config.targets.maxima).any())
    return beyond


def test_it_moves_and_keeps_to_the_maxima_which_greedy_does_not(env):
    limited = GreedyLimited(env.unwrapped, 0)
    assert np.mean(play(env, limited, 25)) <= 0.08
    truth = env.unwrapped.episode.trajectory_truth
    assert np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum() > 1.0


def test_expected_divergences_are_predicted_ones_and_what_is_empty(env):
    env.reset(seed=4)
    env.step(1)
    world = env.unwrapped
    planner = GreedyLimited(world)
    poses = world.candidate_poses()
    measure = make_divergence(world.config.divergence, world.intrinsics.scaled(SCALE))
    here = world.episode.T_world_camera_estimate
    views = world.slam.predict(np.concatenate([here[None], poses]), SCALE)
    images = views.intensity, views.depth, views.normals
    now = measure.histograms(*(image[:1] for image in images))
    for n, found in enumerate(planner.expected_divergences(poses), 1):
        seen = measure.histograms(*(image[n : n + 1] for image in images))
        empty = np.count_nonzero(views.depth[n] == 0) / views.depth[n].size
        expected = measure.divergence(seen, now)[0] + empty * np.array([0.4, 0.8])
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9)


def test_of_the_permitted_motions_towards_the_goal_it_takes_the_one_of_line_9(env):
    observation, info = env.reset(seed=5)
    world = env.unwrapped
    planner = GreedyLimited(world, 0)
    planner.reset()
    action = planner.act(observation, info)
    poses, targets = world.candidate_poses(), world.config.targets
    expected = planner.expected_divergences(poses)
    away = distance_in_steps(poses, planner.goal, *planner.steps).sum(axis=1)
    best, smallest = -1, np.inf
    for n, (delta_I, delta_D) in enumerate(expected):
        bound_I, bound_D = 1.3 * (expected[n] + 0.01) - 0.01
        if not info["action_mask"][n] or bound_I > targets.M_I or bound_D > targets.M_D:
            continue
        distance = abs(delta_I - planner.rho * targets.M_I)
        distance += targets.depth_weight * abs(delta_D - planner.rho * targets.M_D)
        if away[n] < away[0] - 0.5 and distance < smallest:
            best, smallest = n, distance
    assert action == best


def test_where_only_standing_still_is_permitted_the_least_divergent_motions_are(env):
    env.reset(seed=5)
    planner = GreedyLimited(env.unwrapped, 0)
    planner.reset()
    possible = np.flatnonzero(env.unwrapped.action_masks())
    expected = np.full((49, 2), 20.0)
    expected[0] = 0
    expected[possible[[3, 9]]] = [[9.0, 9.0], [13.0, 9.0]]
    assert set(np.flatnonzero(planner.permitted(expected))) == {0, *possible[[3, 9]]}


@pytest.mark.parametrize("violations", [0.05, 0.4])
def test_the_factor_learns_the_quantile_that_was_asked_for(env, violations):
    planner = GreedyLimited(env.unwrapped, 0, violations=violations)
    planner.reset()
    rng = np.random.default_rng(0)
    ratios = np.exp(rng.normal([0.1, -0.3], [0.3, 0.6], (4000, 2)))
    exceeded = []
    for ratio in ratios:
        met = ratio * (0.02 + 0.01) - 0.01
        bound = np.exp(planner.log_factor) * (0.02 + 0.01) - 0.01
        exceeded.append(met > bound)
        planner.learn(np.array([0.02, 0.02]), met)
    # Each of the two measures may exceed its maximum in half of what is permitted.
    np.testing.assert_allclose(np.mean(exceeded, axis=0), violations / 2, atol=0.01)


def test_bad_options_are_refused(env):
    with pytest.raises(InputError, match=r"GreedyLimited\.violations = 2 is outside \[0, 1\]"):
        make_planner("ms_slam_baselines:GreedyLimited,violations=2", env.unwrapped)
