"""The receding horizon: the best goal anew after every motion, far goals as `nbv` has them."""

import numpy as np
import pytest
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.receding_nbv import RecedingNextBestView
from small_env import ROOM, small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner
from ms_slam_env.planning.view_goals import best_goal


def played(planner_class, steps=6, **options):
    """Planner and environment after some steps, the actions and the goals."""
    env = small_env(ROOM)
    observation, info = env.reset(seed=0)
    planner = planner_class(env.unwrapped, seed=1, **options)
    planner.reset()
    goals, actions, best = [], [], []
    for _ in range(steps):
        here = env.unwrapped.episode.T_world_camera_estimate.copy()
        actions.append(planner.act(observation, info))
        goals.append(planner.goal)
        camera = env.unwrapped.intrinsics
        best.append(best_goal(planner.map.grid, here, camera, planner.steps))
        observation, *_, info = env.step(actions[-1])
    return planner, env.unwrapped, actions, goals, best


def test_every_motion_is_the_first_towards_the_best_goal_of_all_that_is_known_by_then():
    planner, world, actions, goals, best = played(RecedingNextBestView)
    np.testing.assert_array_equal(goals, best)
    assert len(np.unique(np.round(goals, 6), axis=0)) > 1
    assert planner.is_near
    assert all(world.action_space.contains(action) for action in actions)


def test_the_seed_of_the_far_goals_changes_nothing_near_by():
    first, again = (played(RecedingNextBestView)[2] for _ in range(2))
    assert first == again


def test_where_no_view_near_by_gains_enough_it_is_nbv():
    _, _, actions, goals, _ = played(RecedingNextBestView, enough_m3=1000.0)
    _, _, expected, expected_goals, _ = played(NextBestView, enough_m3=1000.0)
    assert actions == expected
    np.testing.assert_array_equal(goals, expected_goals)


def test_it_is_found_by_its_name_and_goes_back_when_lost():
    env = small_env(ROOM).unwrapped
    planner = make_planner("receding-nbv,enough_m3=0.5", env)
    assert isinstance(planner.planner, RecedingNextBestView)
    assert planner.planner.enough_m3 == pytest.approx(0.5)
