"""Planners know what the robot knows: none of ours touches the truth."""

from __future__ import annotations

from contextlib import contextmanager

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines import Foresight, GreedyDivergence, Oracle

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env import ActiveSlamEnv, Episode, Planner, PrivilegedPlanner, RobotView
from ms_slam_env.env.episode import FrameRecord
from ms_slam_env.env.planners import PLANNERS, Recovering, make_planner, planner_observation
from ms_slam_env.env.robot_view import TRUTH, PrivilegedView
from ms_slam_env.env.simulation import Simulation
from ms_slam_env.errors import InputError
from ms_slam_env.robot import Embodiment
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.slam import SlamBackend

PRIVILEGED = ("foresight", "oracle")
CHOSEN = {
    "agent-home": [40, 40, 33, 33, 33, 31, 33, 33],
    "agent-paper": [36, 30, 22, 30, 43, 9, 22, 44],
    "agent-ppo": [12, 12, 10, 10, 13, 13, 13, 13],
    "agent-room": [45, 45, 46, 27, 27, 18, 18, 33],
    "agent-sb3": [8, 9, 9, 9, 9, 9, 9, 8],
    "belief": [41, 41, 41, 27, 24, 22, 27, 4],
    "graph-dopt": [40, 40, 33, 33, 39, 41, 39, 27],
    "greedy": [15, 30, 1, 30, 22, 44, 22, 44],
    "greedy-limited": [33, 39, 33, 38, 32, 38, 28, 5],
    "held-nbv": [40, 39, 41, 6, 27, 27, 27, 27],
    "max-information": [17, 17, 17, 17, 17, 17, 17, 17],
    "nbv": [40, 40, 33, 33, 33, 31, 33, 33],
    "random": [14, 39, 9, 2, 39, 28, 30, 42],
    "receding-nbv": [6, 41, 41, 40, 40, 33, 33, 33],
    "stationary": [0, 0, 0, 0, 0, 0, 0, 0],
}
"""What our planners chose when they held the whole environment."""

TRUE_ATTRIBUTES = (
    (FrameRecord, ("T_world_camera", "T_world_camera_kinematic", "pose_error")),
    (Episode, ("pose_error", "pose_errors", "ate", "trajectory_truth", "trajectory_kinematics")),
    (ActiveSlamEnv, ("scene", "sensor", "coverage", "foresee_terms", "save_state")),
)


def make(**options):
    options = {"scene_seed": 1000, "image_size": "80x60", "disable_env_checker": True} | options
    return gym.make("MSActiveSLAM-FreeCamera-v0", **options)


@pytest.fixture(scope="module")
def played():
    env = make()
    env.reset(seed=7)
    yield env.unwrapped, env.step(1)[-1]
    env.close()


@contextmanager
def without_the_truth():
    """A stretch in which who reads the truth gets an error."""

    def refuse(*_):
        raise AssertionError("the truth was touched")

    with pytest.MonkeyPatch.context() as patch:
        for cls, names in TRUE_ATTRIBUTES:
            for name in names:
                patch.setattr(cls, name, property(refuse), raising=False)
        yield


def test_all_planners_are_tried():
    assert {*CHOSEN, *PRIVILEGED, "policy"} == {*PLANNERS.names()}


@pytest.mark.parametrize("name", CHOSEN)
def test_our_planners_choose_the_same_where_the_truth_cannot_be_touched(name):
    env = make(observation=planner_observation(name))
    observation, info = env.reset(seed=7)
    planner = make_planner(name, env.unwrapped, 7)
    planner.reset()
    actions = []
    for _ in range(len(CHOSEN[name])):
        known = planner.known(info)
        with without_the_truth():
            actions.append(int(planner.act(observation, known)))
        observation, *_, info = env.step(actions[-1])
    env.close()
    assert actions == CHOSEN[name]


@pytest.mark.parametrize("name", PRIVILEGED)
def test_those_that_need_the_truth_would_notice(name):
    env = make()
    observation, info = env.reset(seed=7)
    planner = make_planner(name, env.unwrapped, 7)
    with without_the_truth(), pytest.raises(AssertionError, match="the truth was touched"):
        planner.act(observation, planner.known(info))


def test_info_is_told_without_the_truth(played):
    env, info = played
    planner = make_planner("nbv", env)
    assert set(planner.known(info)) == {
        *("T_world_camera_estimate", "pose_covariance", "divergence", "tracking_ok", "submap"),
        *("action_mask", "time", "energy"),
    }
    assert set(info) - set(planner.known(info)) == set(TRUTH)
    assert make_planner("oracle", env).known(info) is info


def test_no_public_attribute_leads_to_the_environment(played):
    view = RobotView(played[0])
    shown = [name for name in dir(view) if not name.startswith("_")]
    values = [getattr(view, name) for name in shown]
    needs_poses = ("predict", "project")
    values += [value() for value in values if callable(value) and value.__name__ not in needs_poses]
    truth = (ActiveSlamEnv, Episode, Simulation, Scene, Embodiment, SlamBackend, FrameRecord)
    assert len(shown) > 20
    assert not any(isinstance(value, truth) for value in values)


def test_a_view_says_what_the_environment_estimates(played):
    env, info = played
    view = RobotView(env)
    np.testing.assert_array_equal(view.T_world_camera_estimate, info["T_world_camera_estimate"])
    np.testing.assert_array_equal(view.trajectory_estimate, env.episode.trajectory_estimate)
    np.testing.assert_array_equal(view.step_divergences[-1], info["divergence"])
    np.testing.assert_array_equal(view.action_masks(), info["action_mask"])
    np.testing.assert_array_equal(view.surface_points(), env.slam.surface_points())
    assert view.tracked.tolist() == [True, True]
    assert view.occupancy is None
    assert view.seconds is None
    assert (view.step_m, view.step_rad) == (env.config.step_m, env.config.step_rad)


def test_who_asks_for_the_truth_is_told_who_may_have_it(played):
    class Curious(Planner):
        def act(self, observation, info):
            return int(self.robot.scene.seed)

    class Told(PrivilegedPlanner, Curious):
        pass

    env, _ = played
    with pytest.raises(AttributeError, match=r"no 'scene'.*PrivilegedPlanner"):
        Curious(env).act(None, {})
    with pytest.raises(InputError, match="Told needs the truth, which no RobotView has"):
        Told(RobotView(env))
    assert Told(env).act(None, {}) == 1000


def test_a_planner_of_a_planner_knows_as_much(played):
    env, _ = played
    oracle = make_planner("oracle", env)
    assert isinstance(oracle, Recovering)
    assert isinstance(oracle.planner, Oracle)
    assert isinstance(oracle.planner.robot, PrivilegedView)
    assert isinstance(Foresight(env).robot, PrivilegedView)
    assert type(GreedyDivergence(env).robot) is RobotView
