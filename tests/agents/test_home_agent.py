"""The policy near by, goals beyond: which of the two chooses each motion."""

import pytest
from ms_slam_agents.home_agent import HomeAgent, HomePolicy
from ms_slam_agents.policy_planner import SHIPPED
from ms_slam_baselines.nbv import NextBestView
from small_env import ROOM, small_env

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.planners import make_planner, planner_observation
from ms_slam_env.errors import InputError
from ms_slam_env.planning.candidates import GRID_NAMES


def play(planner_class, steps=8, before=lambda *_: None, **options):
    """Actions of a planner and whether it was on the way to a goal."""
    env = small_env(ROOM, observation="held")
    observation, info = env.reset(seed=0)
    planner = planner_class(env.unwrapped, seed=1, **options)
    planner.reset()
    actions, has_goal = [], []
    for step in range(steps):
        before(planner, step)
        actions.append(planner.act(observation, info))
        has_goal.append(getattr(planner, "goal", None) is not None)
        observation, *_, info = env.step(actions[-1])
    return actions, has_goal


def test_while_there_is_something_to_see_near_by_it_is_the_policy():
    actions, has_goal = play(HomeAgent, enough_m3=0.0, risk=1.0)
    assert actions == play(HomePolicy)[0]
    assert not any(has_goal)


def test_where_there_is_too_little_it_is_nbv():
    actions, has_goal = play(HomeAgent, enough_m3=1000.0)
    assert actions == play(NextBestView, enough_m3=1000.0)[0]
    assert all(has_goal)


def test_where_it_has_been_before_it_goes_to_a_goal_and_then_the_policy_goes_on():
    chosen = []

    def before(planner, step):
        here = planner.robot.T_world_camera_estimate
        if step == 2:
            planner.passed.append(here.copy())
        chosen.append(planner.leaves)

    actions, has_goal = play(HomeAgent, 30, before, enough_m3=0.0, replan=3)
    assert not any(has_goal[:2])
    assert has_goal[2]
    assert actions[:2] == play(HomePolicy, 2)[0]
    assert not all(has_goal[3:])
    assert any(chosen)


def test_the_motion_that_lost_tracking_is_not_made_again():
    env = small_env(ROOM, observation="held")
    observation, info = env.reset(seed=0)
    planner = HomeAgent(env.unwrapped, seed=1, enough_m3=0.0)
    wanted = planner.act(observation, info)
    assert planner.goal is None
    planner.lost_by(wanted)
    planner.passed = []
    assert planner.act(observation, info) != wanted


def test_the_policy_chooses_among_the_motions_that_are_not_likely_to_slip():
    risks, safe = [], []

    def before(planner, step):
        if step:
            here = planner.robot.T_world_camera_estimate
            safe.append(planner.safe_motions(here))
            rows = planner.seen[planner.near.policy.metadata.num_state :].reshape(49, -1)
            risks.append(rows[:, GRID_NAMES.index("slip_risk")])

    play(HomeAgent, 8, before, enough_m3=0.0, risk=0.0)
    for risk, can in zip(risks, safe, strict=True):
        assert 0 < can.sum() < 49
        assert risk[can].max() <= 1.3 * risk[1:].min() or not can[1:].any()


def test_a_policy_that_is_not_shown_the_risks_is_refused():
    env = small_env(ROOM, observation="candidates").unwrapped
    with pytest.raises(InputError, match=r"agent-home.*'candidates'; valid choices: goals, held"):
        HomeAgent(env, path=str(SHIPPED / "paper.safetensors"))


def test_it_is_found_by_its_name_with_options_and_the_observation_of_its_policy():
    env = small_env(ROOM, observation="held").unwrapped
    assert planner_observation("agent-home") == "held"
    planner = make_planner("agent-home,enough_m3=0.5", env)
    assert planner.planner.enough_m3 == pytest.approx(0.5)
    with pytest.raises(InputError, match="no_such"):
        make_planner("agent-home,path=no_such.safetensors", env)
    with pytest.raises(InputError, match="overlap"):
        make_planner("agent-home,overlap=2", env)
