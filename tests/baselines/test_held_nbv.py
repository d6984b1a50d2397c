"""Motions that are held: what they are worth, which is taken, and what is said of the others."""

import numpy as np
import pytest
from ms_slam_baselines.held_nbv import HeldNextBestView
from ms_slam_baselines.nbv import NextBestView
from small_env import ROOM, small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.planning import held_gain


def play(planner_class, steps=6, look=lambda *_: None, **options):
    """The actions of a planner, looked at after each of them."""
    env = small_env(ROOM)
    observation, info = env.reset(seed=0)
    planner = planner_class(env.unwrapped, seed=1, **options)
    planner.reset()
    actions = []
    for _ in range(steps):
        here = env.unwrapped.episode.T_world_camera_estimate.copy()
        actions.append(planner.act(observation, info))
        look(planner, here, actions[-1])
        observation, *_, info = env.step(actions[-1])
    return actions


def test_the_best_of_the_admissible_motions_is_taken_and_preferred():
    def look(planner, here, action):
        motions = planner.robot.candidate_motions()
        gain = held_gain(planner.map.grid, here, motions, 6, planner.robot.intrinsics)
        worth = np.where(planner.can, (gain * 0.93 ** np.arange(6)).sum(axis=1), -1)
        assert action == worth.argmax()
        preferred = planner.preferences()
        assert preferred.sum() == pytest.approx(1)
        assert preferred.argmax() == action
        assert not preferred[~planner.can].any()
        assert preferred[planner.can].min() > 0
        second = np.argsort(-worth, kind="stable")[1]
        expected = np.exp((worth[second] / worth[action] - 1) / 0.05)
        assert preferred[second] / preferred[action] == pytest.approx(expected)

    assert len(set(play(HeldNextBestView, look=look))) > 1


def test_where_no_motion_shows_enough_it_is_nbv():
    def look(planner, here, action):
        assert planner.preferences() is None

    actions = play(HeldNextBestView, look=look, least_m3=1000.0, enough_m3=1.0)
    assert actions == play(NextBestView)


def test_a_motion_is_worth_less_by_what_its_risk_to_slip_costs():
    chosen = []

    def look(planner, here, action):
        risks = np.where(planner.can, planner.seen_risks, 0)
        worth = np.where(planner.can, planner.values(here) - 60 * risks, -np.inf)
        assert action == worth.argmax()
        assert planner.preferences().argmax() == action
        chosen.append((planner.seen_risks[action], planner.values(here).argmax() == action))

    play(HeldNextBestView, look=look, slip_cost=60.0)
    assert not all(as_without for _, as_without in chosen)


def test_it_is_found_by_its_name_says_what_it_prefers_and_refuses_what_it_cannot():
    env = small_env(ROOM)
    planner = make_planner("held-nbv,horizon=3", env.unwrapped)
    assert planner.planner.horizon == 3
    observation, info = env.reset(seed=0)
    planner.reset()
    action = planner.act(observation, info)
    assert planner.preferences().argmax() == action
    planner.act(observation, {**info, "tracking_ok": False})  # it undoes the motion
    assert planner.preferences() is None
    for option in ("horizon=0", "discount=1.5", "least_m3=-1", "slip_cost=.nan"):
        with pytest.raises(InputError, match=option.split("=")[0]):
            make_planner(f"held-nbv,{option}", env.unwrapped)


def test_where_held_motions_lead_back_it_goes_to_a_goal_until_it_is_reached():
    env = small_env(ROOM)
    observation, info = env.reset(seed=0)
    planner = HeldNextBestView(env.unwrapped, seed=1)
    planner.reset()
    planner.act(observation, info)
    here = env.unwrapped.episode.T_world_camera_estimate.copy()
    elsewhere, near_here = here.copy(), here.copy()
    elsewhere[0, 3] += planner.steps[0]
    near_here[0, 3] += 0.4 * planner.steps[0]
    assert [len(planner.passed), planner.leaves] == [1, False]
    assert not planner.must_leave(elsewhere)
    assert len(planner.passed) == 2
    assert planner.must_leave(near_here)
    assert planner.passed == []
    planner.find_goal(near_here)
    goal = planner.goal
    assert planner.must_leave(near_here)
    assert planner.goal is goal
    assert not planner.must_leave(goal)
    assert planner.goal is None
