"""Many cameras in scenes of their own take the frames that one sensor a scene takes."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env import scenes
from ms_slam_env.camera import xtion
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.camera_batch import CameraBatch
from ms_slam_env.sensor.native import frame_key, frame_keys
from ms_slam_env.sensor.noise import noise_config

CAMERA = xtion("80x60")
PLACES = (("table", 0), ("wall", 1), ("table", 0), ("table", 2))


def test_keys_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    seeds = np.append(rng.integers(2**31, size=200), [0, 0, 1, 2**32 - 1])
    indices = np.append(rng.integers(1000, size=200), [0, 1, 0, 2**32 - 1])
    expected = [frame_key(int(s), int(i)) for s, i in zip(seeds, indices, strict=True)]
    np.testing.assert_array_equal(frame_keys(seeds, indices), expected)


@pytest.fixture(scope="module")
def sensors() -> list[RGBDSensor]:
    built = {place: RGBDSensor(scenes.make(place[0], place[1]), CAMERA) for place in set(PLACES)}
    return [built[place] for place in PLACES]


def taken(sensors: list[RGBDSensor], noise: str, packets: bool):
    """Images and true depth of a batch, and of each sensor alone."""
    batch = CameraBatch(len(sensors), CAMERA, noise_config(noise), "cpu", packets)
    rng = np.random.default_rng(0)
    for camera, sensor in enumerate(sensors):
        batch.enter(camera, sensor)
    # The last camera moves to another scene, as at a reset.
    batch.capture(np.tile(np.eye(4), (len(sensors), 1, 1)), np.zeros(4, int), np.zeros(4, int))
    sensors = [*sensors[:-1], sensors[1]]
    batch.enter(len(sensors) - 1, sensors[-1])
    poses = np.stack([sensor.scene.sample_start(rng) for sensor in sensors])
    seeds, indices = np.array([5, 2**31 - 1, 0, 7]), np.array([0, 3, 12, 100])
    batch.capture(poses, seeds, indices)
    alone = []
    for sensor, pose, seed, index in zip(sensors, poses, seeds, indices, strict=True):
        frame = sensor.with_noise(noise).capture(pose, int(index), seed=int(seed))
        alone.append((frame.color, frame.depth))
    colors, depths = map(np.stack, zip(*alone, strict=True))
    return batch.color.numpy(), batch.depth.numpy(), colors, depths


@pytest.mark.parametrize("noise", ["kinect", "none"])
def test_images_are_those_of_each_sensor_alone(sensors: list[RGBDSensor], noise: str) -> None:
    color, depth, colors, depths = taken(sensors, noise, packets=True)
    np.testing.assert_array_equal(color, colors)
    np.testing.assert_array_equal(depth, depths)
    assert (depths > 0).mean() > 0.3


def test_rays_that_warp_casts_hit_the_same(sensors: list[RGBDSensor]) -> None:
    """What a GPU runs; a ray at an edge may hit the neighbouring face."""
    color, depth, colors, depths = taken(sensors, "none", packets=False)
    assert (np.abs(depth - depths) < 1e-4).mean() > 0.999
    assert (np.abs(color.astype(int) - colors) <= 1).mean() > 0.999
