"""Black frames are told from plain walls, and stop a SLAM that has a coloured map."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.surfel.photometry import InvalidFrameDetector, is_invalid_frame

CAMERA = xtion("160x120")
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])


def _image(mean: float, noise: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.clip(rng.normal(mean, noise, (*CAMERA.shape, 3)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("mean", "noise", "blank"),
    [(0, 0, True), (4, 2, True), (253, 1, True), (128, 0, True), (128, 1.5, False), (20, 9, False)],
)
def test_what_is_blank(mean, noise, blank):
    both = np.stack([_image(mean, noise), _image(100, 30)])
    np.testing.assert_array_equal(is_invalid_frame(both), [blank, False])


def test_only_where_the_first_frame_was_not():
    frames = InvalidFrameDetector(2)
    black, image = _image(0, 0), _image(100, 30)
    started = np.zeros(2, dtype=bool)
    np.testing.assert_array_equal(frames.find(np.stack([black, image]), started), [False, False])
    started[:] = True
    np.testing.assert_array_equal(frames.find(np.stack([black, black]), started), [False, True])
    np.testing.assert_array_equal(frames.find(np.stack([image, image]), started), [False, False])


def _frames(scene: BoxScene, count: int) -> list[RGBDFrame]:
    sensor = RGBDSensor(scene, CAMERA, noise="kinect", seed=0)
    motion = make_pose(so3_exp([0, np.radians(-0.5), 0]), [0.01, 0, 0.002])
    pose, frames = START, []
    for index in range(count):
        frames.append(sensor.capture(pose, index))
        pose = pose @ motion
    return frames


@pytest.mark.parametrize("depth_too", [True, False])
def test_a_black_frame_is_lost_at_once_and_tracking_resumes(box_scene, depth_too):
    frames = _frames(box_scene, 9)
    backend = slam.make("surfel", CAMERA, max_surfels=60_000, depth_cutoff_m=4.0)
    backend.reset(START)
    for frame in frames[:5]:
        backend.track(frame)
    before = backend.surface_points()
    for frame in frames[5:8]:
        depth = np.zeros_like(frame.depth) if depth_too else frame.depth
        result = backend.track(RGBDFrame(np.zeros_like(frame.color), depth))
        assert not result.tracking_ok
        assert "black" in result.reason
    np.testing.assert_array_equal(backend.surface_points(), before)
    state = backend.get_state()
    assert backend.track(frames[8]).tracking_ok
    backend.set_state(state)
    assert not backend.track(RGBDFrame(np.zeros_like(frames[8].color), frames[8].depth)).tracking_ok


def test_a_recording_without_colour_is_tracked(box_scene):
    backend = slam.make("surfel", CAMERA, max_surfels=60_000, depth_cutoff_m=4.0)
    backend.reset(START)
    for frame in _frames(box_scene, 5):
        result = backend.track(RGBDFrame(np.zeros_like(frame.color), frame.depth))
        assert result.tracking_ok, result.reason
