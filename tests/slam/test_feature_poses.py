"""Poses from features against the truth, and doubt where the map disagrees."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import (
    invert,
    look_at,
    make_pose,
    relative_angle,
    se3_log,
    so3_exp,
    transform_points,
)
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared import feature_poses
from ms_slam_env.slam.shared.feature_poses import KeyframeImages, LastFrames
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.point_poses import Sightings, refine_pose, sighting_covariance
from ms_slam_env.slam.surfel.keyframe_search import FernRelocalization

CAMERA = xtion("160x120")
TURN = make_pose(so3_exp(np.radians([4.0, 12.0, 3.0])), np.array([0.12, 0.03, 0.06]))


EYE = np.array([-0.8, -0.8, 1.2])


@pytest.fixture(scope="module")
def sensor(box_scene: BoxScene) -> RGBDSensor:
    return RGBDSensor(box_scene, CAMERA, noise="kinect", seed=3)


@pytest.fixture(scope="module")
def start() -> np.ndarray:
    return look_at(EYE, EYE + np.array([1.0, 0.2, -0.35]))


def _kept(frame: RGBDFrame, pose: np.ndarray) -> LastFrames:
    frames = LastFrames(1, CAMERA)
    images = Images(frame.color[None], frame.depth[None])
    frames.keep(images, pose[None], np.ones(1, dtype=bool))
    return frames


def test_features_find_a_motion_of_many_frames(sensor, start):
    before, after = sensor.capture(start, 0), sensor.capture(start @ TURN, 1)
    found = _kept(before, start).find(0, after.color, after.depth, 8.0)
    assert found is not None
    pose, support = found
    error = invert(start @ TURN) @ pose
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert relative_angle(np.eye(3), error[:3, :3]) < np.radians(1.0)
    assert support.is_strong
    again = _kept(before, start).find(0, after.color, after.depth, 8.0)
    np.testing.assert_array_equal(pose, again[0])


def test_the_covariance_is_that_of_independent_noise(sensor, start):
    """Sightings with the noise that they say they have scatter poses as the covariance says."""
    rng = np.random.default_rng(0)
    truth = start @ TURN
    points = start[:3, 3] + rng.uniform(0.8, 3.0, (80, 1)) * (
        CAMERA.rays_at(rng.uniform([0, 0], [159, 119], (80, 2))) @ truth[:3, :3].T
    )
    seen = transform_points(invert(truth), points)
    pixels = seen[:, :2] / seen[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    sigma_px, sigma_inverse_depth = np.full(80, 0.5), 0.004
    twists = []
    for _ in range(300):
        noisy = Sightings(
            pixels + rng.normal(0, 0.5, pixels.shape),
            1 / seen[:, 2] + rng.normal(0, sigma_inverse_depth, 80),
            sigma_px,
            sigma_inverse_depth,
        )
        T, _ = refine_pose(truth, points, noisy, CAMERA, rounds=1)
        twists.append(se3_log(invert(truth) @ T))
    predicted = sighting_covariance(truth, points, noisy, CAMERA)
    measured = np.cov(np.array(twists).T)
    # 300 draws know a standard deviation to 4 %; Huber's weights add a little.
    np.testing.assert_allclose(np.sqrt(np.diag(measured) / np.diag(predicted)), 1, atol=0.2)
    whitened = np.linalg.solve(np.linalg.cholesky(predicted), np.array(twists).T)
    assert 5.0 < np.mean((whitened**2).sum(axis=0)) < 8.0  # chi squared of six


def test_features_are_the_same_whether_they_were_sought_before_or_not(sensor, start):
    frames = [sensor.capture(start @ np.linalg.matrix_power(TURN, k), k) for k in range(3)]
    chain = _kept(frames[0], start)
    for k in (1, 2):
        again = _kept(frames[k - 1], start).find(0, frames[k].color, frames[k].depth, 8.0)
        found = chain.find(0, frames[k].color, frames[k].depth, 8.0)
        assert (found is None) == (again is None)
        if found is not None:
            np.testing.assert_array_equal(found[0], again[0])
        images = Images(frames[k].color[None], frames[k].depth[None])
        chain.keep(images, start[None], np.ones(1, dtype=bool))


def test_features_of_what_moves_are_left_out_of_the_last_frame(sensor, start):
    """Depth is kept without it, so that the features sought with it serve no more."""
    frames = [sensor.capture(start @ np.linalg.matrix_power(TURN, k), k) for k in range(3)]
    still = frames[1].depth.copy()
    still[:, :80] = 0
    chain = _kept(frames[0], start)
    chain.find(0, frames[1].color, frames[1].depth, 8.0)
    chain.keep(Images(frames[1].color[None], still[None]), start[None], np.ones(1, dtype=bool))
    found = chain.find(0, frames[2].color, frames[2].depth, 8.0)
    fresh = _kept(RGBDFrame(frames[1].color, still), start)
    again = fresh.find(0, frames[2].color, frames[2].depth, 8.0)
    np.testing.assert_array_equal(found[0], again[0])


def test_another_place_has_no_strong_support(sensor, start):
    elsewhere = sensor.capture(look_at(EYE, EYE + np.array([-1.0, 0.1, -0.35])), 1)
    found = _kept(sensor.capture(start, 0), start).find(0, elsewhere.color, elsewhere.depth, 8.0)
    assert found is None or not found[1].is_strong


def test_without_a_frame_features_say_nothing(sensor, start):
    frame = sensor.capture(start, 0)
    frames = _kept(frame, start)
    frames.forget(0)
    assert frames.find(0, frame.color, frame.depth, 8.0) is None


def _walk(sensor, start: np.ndarray, count: int) -> list[tuple[RGBDFrame, np.ndarray]]:
    step = make_pose(so3_exp(np.radians([0.0, 1.0, 0.0])), np.array([0.01, 0.0, 0.005]))
    poses = [start]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return [(sensor.capture(pose, index), pose) for index, pose in enumerate(poses)]


def test_a_leap_that_the_motion_model_does_not_expect_is_tracked(sensor, start):
    backend = slam.make("surfel", CAMERA)
    backend.reset(start)
    walk = _walk(sensor, start, 8)
    for frame, _ in walk:
        assert backend.track(frame).tracking_ok
    there = walk[-1][1] @ make_pose(so3_exp(np.radians([9.0, -19.0, 12.0])), [0.15, 0.05, 0.05])
    result = backend.track(sensor.capture(there, 99))
    assert result.tracking_ok
    assert np.linalg.norm(result.T_world_camera[:3, 3] - there[:3, 3]) < 0.03


def test_an_uncertain_frame_is_tracked_and_not_fused(sensor, start):
    """No alignment can meet these rules, so that only features speak for the poses."""
    rules = {"acceptance": {"inliers": 1.0, "doubted": {"inliers": 1.0}}}
    backend = slam.make("surfel", CAMERA, **rules)
    backend.reset(start)
    walk = _walk(sensor, start, 4)
    backend.track(walk[0][0])
    count = len(backend.surface_points())
    results = [backend.track(frame) for frame, _ in walk[1:]]
    assert all(result.uncertain and result.tracking_ok and not result.fused for result in results)
    assert len(backend.surface_points()) == count
    for result, (_, pose) in zip(results, walk[1:], strict=True):
        assert np.linalg.norm(result.T_world_camera[:3, 3] - pose[:3, 3]) < 0.02
        assert np.sqrt(result.covariance[0, 0]) >= 0.03


START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])
STEP = make_pose(so3_exp([0, np.radians(-3.0), 0]), [0.01, 0, 0])
COUNT = 40


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    return np.stack([START @ np.linalg.matrix_power(STEP, k) for k in range(COUNT)])


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
