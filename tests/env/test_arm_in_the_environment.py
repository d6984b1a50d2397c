"""The arm as the default embodiment: frames of a motion, energy, state with physics."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_array_equal

OPTIONS = {"scene": "table", "scene_seed": 0, "arm": {"frames_per_action": 2}}


@pytest.fixture(scope="module")
def env():
    env = gym.make("MSActiveSLAM-v0", **OPTIONS).unwrapped
    env.reset(seed=0)
    return env


def walk(env, count, seed=0):
    rng = np.random.default_rng(seed)
    return [env.step(int(rng.choice(np.flatnonzero(env.action_masks())))) for _ in range(count)]


def assert_equal_steps(first, second):
    for (obs_a, reward_a, *_, info_a), (obs_b, reward_b, *_, info_b) in zip(
        first, second, strict=True
    ):
        assert_array_equal(obs_a, obs_b)
        assert reward_a == reward_b
        for key in ("T_world_camera", "T_world_camera_estimate", "action_mask", "energy", "time"):
            assert_array_equal(info_a[key], info_b[key], key)


def test_a_saved_episode_goes_on_bit_exactly(env):
    walk(env, 2)
    state, copy = env.save_state(), pickle.loads(pickle.dumps(env))
    went = walk(env, 5, seed=1)
    env.load_state(state)
    assert_equal_steps(went, walk(env, 5, seed=1))
    assert_equal_steps(went, walk(copy, 5, seed=1))


def test_equal_seeds_give_equal_episodes(env):
    other = gym.make("MSActiveSLAM-v0", **OPTIONS).unwrapped
    for one in (env, other):
        one.reset(seed=3)
    assert_equal_steps(walk(env, 3), walk(other, 3))
    assert_array_equal(env.episode.trajectory_kinematics, other.episode.trajectory_kinematics)


def test_frames_energy_and_timings_are_counted(env):
    env.reset(seed=1)
    env.timings.clear()
    infos = [step[4] for step in walk(env, 4)]
    assert len(env.episode.trajectory_truth) == 1 + 4 * 2
    assert (np.diff([info["energy"] for info in infos]) > 0).all()
    assert {"ik", "physics", "mask", "move", "slam", "render"} <= set(env.timings.total)
    off = np.linalg.norm(
        env.episode.trajectory_truth[:, :3, 3] - env.episode.trajectory_kinematics[:, :3, 3], axis=1
    )
    assert off[0] < 1e-12
    assert 0 < off[-1] < 0.03


def test_make_vec_steps_several_arms():
    envs = gym.make_vec("MSActiveSLAM-v0", 2, **OPTIONS)
    _, info = envs.reset(seed=4)
    actions = [int(np.flatnonzero(mask)[-1]) for mask in info["action_mask"]]
    _, rewards, *_, info = envs.step(np.array(actions))
    assert rewards.shape == (2,)
    assert (info["energy"] > 0).all()
    envs.close()
