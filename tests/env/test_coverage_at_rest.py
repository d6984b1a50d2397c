"""A camera at rest maps nothing new, whatever its sensor's noise."""

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.sensor import RGBDSensor


def test_a_camera_at_rest_is_not_paid_for_noise():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene_seed=1000, noise="kinect")
    _, info = env.reset(seed=0)
    at_start = info["mapped_area"]
    for _ in range(8):
        *_, info = env.step(0)
    assert at_start > 1.0
    # pixels at depth edges have a reading in one frame and none in the next: a little may come
    assert info["mapped_area"] < 1.05 * at_start


def test_last_true_depth_is_that_of_the_noise_free_view():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene_seed=1000)
    _, info = env.reset(seed=0)
    sensor = env.unwrapped.sensor
    last = sensor.last_true_depth().copy()
    np.testing.assert_array_equal(last, sensor.ground_truth(info["T_world_camera"]).depth)


def test_no_last_depth_before_the_first_frame(box_scene):
    sensor = RGBDSensor(box_scene, xtion("160x120"))
    with pytest.raises(InputError, match="no frame"):
        sensor.last_true_depth()
