"""The environment whose agent chooses motion and SLAM configuration."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError

ID = "MSActiveSLAM-Adaptive-v0"
OPTIONS = {"scene": "living_room", "scene_seed": 0, "embodiment": "free"}
PLAIN = "MSActiveSLAM-FreeCamera-v0"


@pytest.fixture(scope="module")
def env():
    return gym.make(ID, **OPTIONS)


def actions(env, count, seed=0):
    """Random possible pairs of motion and configuration."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        possible = np.flatnonzero(env.unwrapped.action_masks()[:49])
        yield np.array([rng.choice(possible), rng.integers(3)])


def assert_same_steps(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
        assert a[1:4] == b[1:4]
        for key in a[4]:
            np.testing.assert_equal(a[4][key], b[4][key])


def test_the_id_is_listed_and_has_an_arm_unless_told_otherwise():
    assert ID in ms_slam_env.ENV_IDS
    env = gym.make(ID, scene="table", scene_seed=0)
    assert type(env.unwrapped) is ActiveSlamEnv
    np.testing.assert_array_equal(env.action_space.nvec, [49, 3])
    env.reset(seed=0)
    assert env.unwrapped.embodiment.__class__.__name__ == "DynamicArm"


def test_the_mask_is_flat_and_the_configuration_is_seen(env):
    observation, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["action_mask"], env.unwrapped.action_masks())
    assert info["action_mask"].shape == (49 + 3,)
    np.testing.assert_array_equal(info["action_mask"][:49], env.unwrapped.embodiment.action_masks())
    assert info["action_mask"][49:].all()
    np.testing.assert_array_equal(observation[-3:], [0, 0, 1])  # the most robust at the start
    for index in (0, 2, 1):
        observation, _, _, _, info = env.step(np.array([0, index]))
        np.testing.assert_array_equal(observation[-3:], np.eye(3)[index])
        assert info["slam_configuration"] == env.unwrapped.slam.level == index


def test_the_reward_has_the_cost_and_else_agrees_with_the_plain_environment():
    """With three configurations that are all the default's nothing but the cost differs."""
    same = {"name": "agent", "configurations": [{}, {}, {}], "costs": [1, 2, 4]}
    adaptive = gym.make(ID, adaptation=same, reward={"compute": 0.5}, **OPTIONS)
    plain = gym.make(PLAIN, **{k: v for k, v in OPTIONS.items() if k != "embodiment"})
    a, b = adaptive.reset(seed=3), plain.reset(seed=3)
    np.testing.assert_array_equal(a[0][:-3], b[0])
    for step, motion in enumerate([7, 14, 3, 42]):
        one, other = adaptive.step(np.array([motion, step % 3])), plain.step(motion)
        terms = one[4]["reward_terms"]
        assert terms.pop("compute") == -0.5 * [1, 2, 4][step % 3]
        assert terms == other[4]["reward_terms"]
        assert one[1] == pytest.approx(other[1] - 0.5 * [1, 2, 4][step % 3])
        np.testing.assert_array_equal(one[0][:-3], other[0])


def test_without_adaptation_nothing_differs_from_before():
    options = {k: v for k, v in OPTIONS.items() if k != "embodiment"}
    default, none = gym.make(PLAIN, **options), gym.make(PLAIN, adaptation="none", **options)
    default.reset(seed=1)
    none.reset(seed=1)
    steps = [(default.step(a), none.step(a)) for a in (7, 21, 4)]
    assert_same_steps(*zip(*steps, strict=True))
    assert "compute" not in steps[0][0][4]["reward_terms"]


def test_by_divergence_it_chooses_for_itself():
    options = {k: v for k, v in OPTIONS.items() if k != "embodiment"}
    env = gym.make(PLAIN, adaptation={"name": "divergence", "dwell_frames": 2}, **options)
    env.reset(seed=0)
    levels = []
    for action in (0, 0, 0, 14, 0, 0, 0):
        env.step(action)
        levels.append(env.unwrapped.slam.level)
    assert levels[0] == 2
    assert levels[2] == 0
    assert levels[3] > 0
    assert levels[-1] == 0


@pytest.mark.parametrize("mode", [None, "sync"])
def test_vector_environments(mode):
    venv = gym.make_vec(ID, num_envs=2, vectorization_mode=mode, **OPTIONS)
    _, info = venv.reset(seed=0)
    assert info["action_mask"].shape == (2, 52)
    info = venv.step(np.array([[0, 0], [0, 2]]))[4]
    np.testing.assert_array_equal(info["slam_configuration"], [0, 2])
    cheap, dear = info["reward_terms"]["compute"]
    assert dear < cheap < 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"adaptation": "none"}, "adaptation must be 'agent'"),
        ({"adaptation": "clever"}, "valid choices: none, divergence, agent|'none' or 'divergence'"),
        ({"slam": "odometry"}, "only the SLAM backend 'surfel'"),
        (
            {"adaptation": {"name": "agent", "costs": [1, 2]}},
            "costs = .* must be 3 increasing positive",
        ),
        (
            {"adaptation": {"name": "agent", "configurations": [{}, {}]}},
            r"configurations\[0\] has no about.cost",
        ),
        ({"reward": {"compute": -1}}, "RewardConfig.compute"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(InputError, match=message) as caught:
        gym.make(ID, **OPTIONS, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "planner",
    ["nbv", "greedy", "stationary", "foresight", "max-information", "random,recovery=true"],
)
def test_planners_of_motions_alone_are_refused(planner):
    world = gym.make(ID, **OPTIONS).unwrapped
    with pytest.raises(
        InputError, match=r"chooses motions only; .*which random, policy or a planner"
    ):
        make_planner(planner, world)
    assert make_planner("random", world)
