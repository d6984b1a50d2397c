"""The observation `images`: what it shows, and that Stable-Baselines3 takes it, and all others."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from small_env import small_env

import ms_slam_env
from ms_slam_env.env.observations import DEPTH_LEVEL_M
from ms_slam_env.env.registry import OBSERVATIONS

SMALL = {"scene": "table", "scene_seed": 0, "image_size": "64x48"}


@pytest.mark.parametrize("noise", ["kinect", "none"])
def test_the_image_is_the_live_frame(noise):
    env = small_env(observation="images", noise=noise)
    env.reset(seed=0)
    seen, *_ = env.step(8)
    frame = env.unwrapped.episode.last_frame
    assert seen in env.observation_space
    assert (seen["image"].dtype, seen["image"].shape) == (np.uint8, (4, 60, 80))
    np.testing.assert_array_equal(np.moveaxis(seen["image"][:3], 0, 2), frame.color)
    levels, depth = seen["image"][3], frame.depth.astype(np.float64)
    assert ((levels == 0) == (depth == 0)).all()
    assert (levels == 0).any() or noise == "none"
    within = (depth > DEPTH_LEVEL_M) & (depth < 254 * DEPTH_LEVEL_M)
    assert within.mean() > 0.5
    assert abs(levels * DEPTH_LEVEL_M - depth)[within].max() <= DEPTH_LEVEL_M / 2 + 1e-6


def test_depth_beyond_both_ends_of_the_scale_is_still_a_reading(monkeypatch):
    env = small_env(observation="images").unwrapped
    env.reset(seed=0)
    depth = env.episode.last_frame.depth
    depth.flags.writeable = True
    depth[0, :6] = 0, 1e-4, DEPTH_LEVEL_M, 5.08, 5.1, 300
    np.testing.assert_array_equal(env._observe()["image"][3, 0, :6], [0, 1, 1, 254, 255, 255])


def test_colour_state_and_depth_are_those_of_rgbd():
    images, rgbd = (small_env(observation=name).reset(seed=3)[0] for name in ("images", "rgbd"))
    assert rgbd["depth"].shape == (60, 80, 1)
    np.testing.assert_array_equal(images["state"], rgbd["state"])
    np.testing.assert_array_equal(np.moveaxis(images["image"][:3], 0, 2), rgbd["color"])


def checked(env_id, observation):
    """Warnings of Stable-Baselines3's checker."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gym.make(env_id, observation=observation, **SMALL)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker.check_env(env, skip_render_check=True)
    env.close()
    return [str(one.message) for one in caught]


@pytest.mark.parametrize("env_id", ms_slam_env.ENV_IDS)
def test_the_checker_of_stable_baselines3_finds_nothing(env_id):
    found = {name: checked(env_id, name) for name in OBSERVATIONS}
    # Its networks would read depth in metres as a vector, so it names the part.
    said = found.pop("rgbd")
    assert said
    assert all("depth is an image" in one for one in said)
    assert {name for name, warned in found.items() if warned} == set()


OTHERS = (*ms_slam_env.TASK_IDS, *ms_slam_env.CONTINUOUS_IDS, *ms_slam_env.PERTURBED_ENV_IDS)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", OTHERS)
def test_the_checker_finds_nothing_with_images(env_id):
    assert checked(env_id, "images") == []


def test_stock_networks_learn_from_images():
    """Also depth passes through convolutions, and both policies change in 64 steps."""
    sb3 = pytest.importorskip("stable_baselines3")
    torch = pytest.importorskip("torch")
    both = small_env(observation="images")
    only = gym.wrappers.TransformObservation(
        both, lambda seen: seen["image"], both.observation_space["image"]
    )
    for policy, env in (("MultiInputPolicy", both), ("CnnPolicy", only)):
        model = sb3.PPO(policy, env, n_steps=32, batch_size=32, n_epochs=1, device="cpu", seed=0)
        network = model.policy.features_extractor
        network = getattr(network, "extractors", {"image": network})["image"]
        assert network.cnn[0].in_channels == 4
        before = network.cnn[0].weight.detach().clone()
        model.learn(64)
        changed = (network.cnn[0].weight - before).abs().amax(dim=(0, 2, 3))
        assert torch.isfinite(changed).all()
        assert (changed > 0).all(), policy
