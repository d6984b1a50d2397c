"""An arm that a user brings: an MJCF with a named camera site, and nothing else."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from ms_slam_env.errors import InputError

SECOND_ARM = str(Path(__file__).parents[1] / "robot" / "second_arm.xml")
ARM = {"model": SECOND_ARM, "camera_site": "lens", "frames_per_action": 1}
OPTIONS = {"scene": "table", "scene_seed": 1000}


@pytest.fixture(scope="module")
def env():
    env = gym.make("MSActiveSLAM-v0", arm=ARM, render_mode="rgb_array", **OPTIONS).unwrapped
    env.reset(seed=0)
    return env


def test_it_moves_the_camera_where_it_is_told(env):
    _, info = env.reset(seed=0)
    rng = np.random.default_rng(0)
    tracked = 0
    for _ in range(4):
        action = int(rng.choice(np.flatnonzero(info["action_mask"][1:]) + 1))
        wanted = info["T_world_camera"] @ env.embodiment.motions[action]
        energy = info["energy"]
        _, _, _, _, info = env.step(action)
        assert np.linalg.norm(info["T_world_camera"][:3, 3] - wanted[:3, 3]) < 0.02
        assert info["energy"] > energy
        tracked += info["tracking_ok"]
    assert tracked >= 3  # one frame a motion is coarse for SLAM: it may lose one
    assert len(env.embodiment.q) == 7
    assert info["action_mask"].sum() > 10


def test_a_masked_motion_is_not_made(env):
    _, info = env.reset(seed=1)
    masked = np.flatnonzero(~info["action_mask"])
    if len(masked) == 0:
        pytest.skip("everything is possible here")
    _, _, _, _, after = env.step(int(masked[0]))
    assert np.linalg.norm(after["T_world_camera"] - info["T_world_camera"]) < 1e-3
    assert after["reward_terms"]["blocked"] < 0


def test_the_picture_shows_the_arm(env):
    env.reset(seed=0)
    with_arm = env.render()
    assert with_arm.shape == (480, 1120, 3)
    red, green, blue = np.moveaxis(with_arm[:, 320:800].astype(int), 2, 0)
    orange = (np.abs(green - 0.53 * red) < 8) & (np.abs(blue - 0.12 * red) < 8) & (red > 90)
    assert orange.sum() > 1000


def test_a_site_that_is_not_there_is_one_clear_error():
    with pytest.raises(InputError, match="no site named 'camera'; its sites: lens, mark"):
        gym.make("MSActiveSLAM-v0", arm={"model": SECOND_ARM}, **OPTIONS)
