"""The observation `pixels`: what the live images show, smaller."""

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.env.observations import PixelsObservation

ROWS, COLUMNS = PixelsObservation.image_shape[1:]


def make(observation="pixels", size="160x120"):
    options = {"scene": "table", "scene_seed": 0, "image_size": size}
    return gym.make("MSActiveSLAM-FreeCamera-v0", observation=observation, **options)


def test_the_images_are_means_of_their_parts():
    env = make()
    env.reset(seed=0)
    seen, *_ = env.step(8)
    frame = env.unwrapped.episode.last_frame
    color, depth = frame.color.astype(float), frame.depth.astype(float)
    high, wide = frame.depth.shape[0] // ROWS, frame.depth.shape[1] // COLUMNS
    expected = np.zeros(PixelsObservation.image_shape)
    for i in range(ROWS):
        for j in range(COLUMNS):
            part = slice(i * high, (i + 1) * high), slice(j * wide, (j + 1) * wide)
            expected[:3, i, j] = color[part].mean(axis=(0, 1)) / 255
            readings = depth[part][depth[part] > 0]
            expected[3, i, j] = readings.mean() / 4 if len(readings) else 0
    assert (expected[3] == 0).any()
    assert (expected[3] > 0).mean() > 0.5
    image = seen[28:].reshape(PixelsObservation.image_shape)
    np.testing.assert_allclose(image, expected, atol=2e-6)


def test_the_state_is_that_of_features():
    assert (make().reset(seed=3)[0][:28] == make("features").reset(seed=3)[0][:28]).all()


@pytest.mark.parametrize("size", ["80x60", "64x48", "321x239", "40x30", "20x16"])
def test_every_camera_shows_as_many_numbers(size):
    env = make(size=size)
    seen, _ = env.reset(seed=0)
    assert env.observation_space.contains(seen)
    assert seen.shape == (28 + np.prod(PixelsObservation.image_shape),)
    assert seen[28:].max() > 0.3
