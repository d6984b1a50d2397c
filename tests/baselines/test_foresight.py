"""Motions tried and taken back: their rewards are those of the steps, and nothing has changed."""

import numpy as np
import pytest
from ms_slam_baselines.foresight import Foresight
from ms_slam_baselines.greedy import GreedyDivergence, distance_to_targets
from small_env import small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.env_config import TargetConfig
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError

TARGETS = TargetConfig()


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("MSActiveSLAM-FreeCamera-v0", {"observation": "candidates", "reward": "paper"}),
        ("MSActiveSLAM-FixedTranslation-v0", {}),
        ("MSActiveSLAM-Adaptive-v0", {}),
    ],
)
def test_what_is_foreseen_is_what_comes_and_nothing_has_changed(env_id, options):
    env, other = small_env(env_id, **options), small_env(env_id, **options)
    for one in (env, other):
        one.reset(seed=3)
        one.step(one.unwrapped.action_space.sample() * 0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(4)]
    rewards = env.unwrapped.foresee(actions)
    np.testing.assert_array_equal(env.unwrapped.foresee(actions[::-1]), rewards[::-1])
    assert len(set(rewards)) > 1
    terms = env.unwrapped.foresee_terms(actions)
    assert [sum(t.values()) for t in terms] == list(rewards)
    seen, reward, *_, info = env.step(actions[2])
    expected, *_, expected_info = other.step(actions[2])
    assert reward == rewards[2]
    np.testing.assert_array_equal(seen, expected)
    np.testing.assert_array_equal(info["divergence"], expected_info["divergence"])


def test_a_motion_that_there_is_not_changes_nothing():
    env, other = small_env(), small_env()
    for one in (env, other):
        one.reset(seed=3)
    with pytest.raises(InputError, match="49"):
        env.unwrapped.foresee([3, 49])
    np.testing.assert_array_equal(env.step(3)[0], other.step(3)[0])
    with pytest.raises(InputError, match="reset"):
        small_env().unwrapped.foresee([0])


def test_the_best_of_those_tried_is_made_and_preferred():
    env = small_env(reward="paper")
    observation, info = env.reset(seed=3)
    planner = Foresight(env.unwrapped, seed=1, tried=6)
    action = planner.act(observation, info)
    preferred = planner.preferences()
    tried = np.flatnonzero(preferred)
    assert len(tried) <= 6
    assert preferred.sum() == pytest.approx(1)
    rewards = env.unwrapped.foresee(tried)
    assert action == tried[rewards.argmax()] == preferred.argmax()
    weights = np.exp((rewards - rewards.max()) / 0.02)
    np.testing.assert_allclose(preferred[tried], weights / weights.sum())
    assert env.step(action)[1] == rewards.max()


def test_in_greedys_order_those_are_tried_that_greedy_ranks_first():
    env = small_env(reward="paper")
    observation, info = env.reset(seed=3)
    greedy = GreedyDivergence(env.unwrapped)
    possible = np.flatnonzero(info["action_mask"])
    ranked = possible[np.argsort(distance_to_targets(*greedy.predicted()[possible].T, TARGETS))]
    for tried in (1, 5):
        planner = Foresight(env.unwrapped, tried=tried, order="greedy", temperature=10)
        action = planner.act(observation, info)
        assert set(np.flatnonzero(planner.preferences())) == set(ranked[:tried])
        assert tried > 1 or action == greedy.act(observation, info)


def test_only_an_error_that_is_no_noise_counts(monkeypatch):
    env = small_env(reward="paper")
    observation, info = env.reset(seed=3)
    terms = [
        {"depth_divergence": -0.02, "trajectory_error": 0.01},
        {"depth_divergence": -0.01, "trajectory_error": -0.03},
        {"depth_divergence": 0.0, "trajectory_error": -0.5},
    ]
    monkeypatch.setattr(env.unwrapped, "foresee_terms", lambda actions: terms)
    best = {}
    for noise in (0.0, 0.03, 1.0):
        planner = Foresight(env.unwrapped, tried=3, order="greedy", noise=noise)
        tried = planner._first(np.flatnonzero(info["action_mask"]))
        best[noise] = list(tried).index(planner.act(observation, info))
    assert best == {0.0: 0, 0.03: 1, 1.0: 2}


def test_terms_left_out_do_not_count():
    env = small_env()
    observation, info = env.reset(seed=3)
    tried = np.flatnonzero(info["action_mask"])
    terms = env.unwrapped.foresee_terms(tried)
    chosen = set()
    for without in ("", "new_surface", "intensity_divergence+depth_divergence+trajectory_error"):
        left = [{k: v for k, v in t.items() if k not in without.split("+")} for t in terms]
        best = tried[np.argmax([sum(t.values()) for t in left])]
        planner = Foresight(env.unwrapped, without=without)
        assert planner.act(observation, info) == best
        chosen.add(best)
    assert len(chosen) > 1


def test_it_is_found_by_its_name_and_refuses_what_it_cannot():
    env = small_env().unwrapped
    assert isinstance(make_planner("foresight,tried=3", env), Foresight)
    assert make_planner("foresight,without=", env).without == ()
    for option in ("tried=0", "temperature=0", "noise=-1", "order=greediest"):
        with pytest.raises(InputError, match=option.split("=")[0]):
            make_planner(f"foresight,{option}", env)
    with pytest.raises(InputError, match=r"term of the reward 'surface'; valid .* new_surface"):
        make_planner("foresight,without=lost+surface", env)
    with pytest.raises(InputError, match="term of the reward '1'"):
        make_planner("foresight,without=1", env)
