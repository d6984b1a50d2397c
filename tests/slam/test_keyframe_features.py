"""A lost frame found by the features of keyframes where their views lead nowhere."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared import feature_poses
from ms_slam_env.slam.shared.feature_poses import KeyframeImages
from ms_slam_env.slam.surfel.keyframe_search import FernRelocalization

CAMERA = xtion("160x120")
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])
TURN = make_pose(so3_exp([0, np.radians(-3.0), 0]), [0.01, 0, 0])
COUNT = 40


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    return np.stack([START @ np.linalg.matrix_power(TURN, k) for k in range(COUNT)])


@pytest.fixture(scope="module")
def frames(box_scene: BoxScene, poses: np.ndarray) -> list[RGBDFrame]:
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)
    return [sensor.capture(pose, index) for index, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def back(box_scene: BoxScene, poses: np.ndarray) -> list[RGBDFrame]:
    """Taken where the path began, a hand's breadth beside it."""
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=1)
    beside = make_pose(so3_exp([0.05, 0.1, 0.1]), [0.1, 0.05, 0.05])
    return [sensor.capture(poses[2] @ beside, index) for index in range(4)]


def _mapped(frames: list[RGBDFrame], variant: str) -> slam.SlamBackend:
    system = slam.make("surfel", CAMERA, relocalisation=variant)
    system.reset(START)
    assert all(system.track(frame).tracking_ok for frame in frames)
    return system


def _found(system: slam.SlamBackend, back: list[RGBDFrame], poses: np.ndarray) -> bool:
    beside = make_pose(so3_exp([0.05, 0.1, 0.1]), [0.1, 0.05, 0.05])
    results = [system.track(frame) for frame in back]
    gap = results[-1].T_world_camera[:3, 3] - (poses[2] @ beside)[:3, 3]
    return results[-1].tracking_ok and bool(np.linalg.norm(gap) < 0.02)


def test_features_find_what_views_of_keyframes_do_not(frames, back, poses, monkeypatch):
    nowhere = lambda self, frames, lost, *rest: np.full((len(lost), 4, 4), np.nan)  # noqa: E731
    monkeypatch.setattr(FernRelocalization, "propose", nowhere)
    assert not _found(_mapped(frames, "ferns"), back, poses)
    system = _mapped(frames, "features")
    state = system.get_state()
    assert _found(system, back, poses)
    restored = slam.make("surfel", CAMERA, relocalisation="features")
    restored.set_state(state)
    assert _found(restored, back, poses)


def test_frames_that_track_are_what_they_are_without(frames):
    ferns, features = (_mapped(frames[:12], variant) for variant in ("ferns", "features"))
    np.testing.assert_array_equal(ferns.surface_points(), features.surface_points())


def test_few_images_are_kept_and_they_stay_spread(frames, monkeypatch):
    monkeypatch.setattr(feature_poses, "MOST_IMAGES", 4)
    images = KeyframeImages(CAMERA)
    for time, frame in enumerate(frames[:6]):
        images.keep(frame.color, frame.depth, time)
    assert images.times == [0, 2, 4, 5]
    direct = images.features_of(frames[4].color, frames[4].depth, 8.0)
    np.testing.assert_array_equal(images.features(4, 8.0).descriptors, direct.descriptors)
    other = KeyframeImages(CAMERA)
    other.set_state(images.get_state())
    np.testing.assert_array_equal(other.features(2, 8.0).pixels, images.features(2, 8.0).pixels)
    assert images.fitting(CAMERA) is images
    assert images.fitting(xtion("80x60")).times == []
