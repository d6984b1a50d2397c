"""Kidnapped cameras find their pose again from keyframes, and no wrong one."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from box_scene import BoxScene
from surfel_scenes import ray_cast

from ms_slam_env import slam
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, RGBDFrame, xtion
from ms_slam_env.geometry import look_at, make_pose, relative_angle, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.alignment_check import is_photometrically_consistent
from ms_slam_env.slam.shared.alignment_measures import measure_photometric_consistency
from ms_slam_env.slam.shared.ferns import FernCode
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig
from ms_slam_env.slam.surfel.keyframe_search import FernRelocalization

CAMERA = xtion("160x120")
OPTIONS = {"max_surfels": 120_000, "depth_cutoff_m": 4.0, "submaps": "off"}
EYE = np.array([-0.8, -0.8, 1.2])
FRAMES = 45


def _path() -> np.ndarray:
    """The camera turns through 90 degrees, 2 a frame, and steps 1 cm a frame sideways."""
    angles = np.radians(np.linspace(0, 90, FRAMES))
    eyes = EYE + np.outer(np.arange(FRAMES), [0.005, 0.008, 0.0])
    aims = np.stack([np.cos(angles), np.sin(angles), np.full(FRAMES, -0.35)], axis=1)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, aims, strict=True)])


@pytest.fixture(scope="module")
def sensor(box_scene: BoxScene) -> RGBDSensor:
    return RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)


@pytest.fixture(scope="module")
def frames(sensor) -> list[RGBDFrame]:
    return [sensor.capture(pose, index) for index, pose in enumerate(_path())]


@pytest.fixture(scope="module")
def mapped(frames) -> dict:
    """State of a SLAM that has tracked the whole path."""
    backend = slam.make("surfel", CAMERA, **OPTIONS)
    backend.reset(_path()[0])
    for frame in frames:
        assert backend.track(frame).tracking_ok
    return backend.get_state()


def _resume(state: dict) -> slam.SlamBackend:
    backend = slam.make("surfel", CAMERA, **OPTIONS)
    backend.set_state(state)
    return backend


def _kidnapped() -> np.ndarray:
    """Poses near the begin of the path, not on it: 12 cm and 9 degrees off, moving on."""
    offset = make_pose(so3_exp(np.radians([3.0, 8.0, 2.0])), [0.08, -0.04, 0.08])
    return _path()[3:13] @ offset


@pytest.fixture(scope="module")
def elsewhere(sensor) -> list[RGBDFrame]:
    return [sensor.capture(pose, 1000 + index) for index, pose in enumerate(_kidnapped())]


def test_a_kidnapped_camera_finds_its_pose_and_fuses_nothing_before(mapped, elsewhere):
    backend = _resume(mapped)
    count = len(backend.surface_points())
    results = []
    for frame, truth in zip(elsewhere, _kidnapped(), strict=True):
        result = backend.track(frame)
        results.append(result)
        if not result.tracking_ok:
            assert len(backend.surface_points()) == count
            continue
        assert np.linalg.norm(result.T_world_camera[:3, 3] - truth[:3, 3]) < 0.02
        assert relative_angle(result.T_world_camera[:3, :3], truth[:3, :3]) < np.radians(1.5)
    tracked = [result.tracking_ok for result in results]
    first = tracked.index(True)
    assert 2 <= first <= 5  # lost, found, confirmed
    assert all(tracked[first:])
    assert [result.relocalised for result in results].index(True) == first


def test_a_pose_to_be_confirmed_is_part_of_the_state(mapped, elsewhere):
    backend = _resume(mapped)
    backend.track(elsewhere[0])
    backend.track(elsewhere[1])
    state = backend.get_state()
    expected = [backend.track(frame) for frame in elsewhere[2:6]]
    other = _resume(state)
    for frame, result in zip(elsewhere[2:6], expected, strict=True):
        again = other.track(frame)
        np.testing.assert_array_equal(again.T_world_camera, result.T_world_camera)
        assert again.tracking_ok == result.tracking_ok
    assert expected[0].tracking_ok
    np.testing.assert_array_equal(other.surface_points(), backend.surface_points())


def test_another_scene_is_never_recognised(mapped):
    sensor = RGBDSensor(BoxScene(seed=7), CAMERA, noise="kinect", seed=3)
    backend = _resume(mapped)
    rng = np.random.default_rng(0)
    for index in range(8):
        pose = look_at(EYE + rng.normal(0, 0.1, 3), rng.uniform([0, 0, 0.2], [2, 2, 1.2]))
        assert not backend.track(sensor.capture(pose, index)).tracking_ok


def test_the_local_search_stays_lost(frames, elsewhere):
    backend = slam.make("surfel", CAMERA, relocalisation="local", **OPTIONS)
    backend.reset(_path()[0])
    for frame in frames:
        backend.track(frame)
    assert not any(backend.track(frame).tracking_ok for frame in elsewhere[:5])


def test_kidnapping_one_env_leaves_the_other_alone(frames, elsewhere):
    config = SurfelConfig(**OPTIONS)
    mapped = frames[::2]
    orders = ([*mapped, *elsewhere[:4]], [*mapped, *mapped[::-1][:4]])
    together, alone = BatchedSurfelSlam(2, CAMERA, config), []
    for env in range(2):
        together.reset(_path()[0], env)
        alone.append(BatchedSurfelSlam(1, CAMERA, config))
        alone[env].reset(_path()[0])
    found = False
    for pair in zip(*orders, strict=True):
        both = np.stack([f.color for f in pair]), np.stack([f.depth for f in pair])
        for env, result in enumerate(together.track(*both)):
            single = alone[env].track(pair[env].color[None], pair[env].depth[None])[0]
            assert single.tracking_ok == result.tracking_ok
            np.testing.assert_array_equal(single.T_world_camera, result.T_world_camera)
            found |= result.relocalised
    assert found


def test_keyframes_follow_a_bent_map():
    ferns = FernRelocalization(1, CAMERA, 3.0)
    rng = np.random.default_rng(0)
    depth = np.ones((1, *CAMERA.shape), dtype=np.float32)
    for time in (3, 5, 9):
        color = np.kron(rng.integers(0, 256, (1, 6, 8, 3)), np.ones((1, 20, 20, 1)))
        frames = Images(color.astype(np.uint8), depth)
        pose = make_pose(np.eye(3), [time, 0.0, 0.0])
        ferns.add_keyframes(frames, pose[None], np.array([time]), np.array([True]))
    bent = np.stack([make_pose(so3_exp([0, 0, 0.1]), [10.0 * time, 1.0, 0.0]) for time in (5, 9)])
    ferns.move_keyframes(0, np.array([5, 9], dtype=np.int32), bent)
    poses = ferns.databases[0].poses
    assert poses[0, 0, 3] == 3  # of a frame that the closure does not know
    np.testing.assert_array_equal(poses[1:], bent)


def test_a_camera_at_rest_is_not_encoded_again(monkeypatch):
    ferns = FernRelocalization(2, CAMERA, 3.0)
    seen, encode = [], ferns.databases[0].encoder.encode_all

    def encode_all(images: Images, envs: np.ndarray) -> FernCode:
        seen.extend(envs.tolist())
        return encode(images, envs)

    monkeypatch.setattr(ferns.databases[0].encoder, "encode_all", encode_all)
    size = (2, *CAMERA.shape)
    nothing = Images(np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32))
    turns = np.radians([0.0, 2.0, 4.0, 5.0])  # of env 1
    for step, turn in zip([0.0, 0.02, 0.04, 0.06], turns, strict=True):
        poses = np.stack(
            [make_pose(np.eye(3), [step, 0, 0]), make_pose(so3_exp([0, turn, 0]), [9, 9, 9])]
        )
        ferns.add_keyframes(nothing, poses, np.zeros(2, np.int32), np.array([True, True]))
    assert seen == [0, 1, 0, 1]
    ferns.add_keyframes(nothing, poses + 0, np.zeros(2, np.int32), np.array([True, False]))
    ferns.clear(1)
    ferns.add_keyframes(nothing, poses, np.zeros(2, np.int32), np.array([False, True]))
    assert seen == [0, 1, 0, 1, 1]


VIEW = Intrinsics(fx=80.0, fy=84.0, cx=39.3, cy=29.8, width=80, height=60)


def _view(T_world_camera: np.ndarray, checks: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of a tilted wall with a fine random texture, by ray casting."""
    depth, _, color = ray_cast(T_world_camera, VIEW, box=False)
    rays = VIEW.rays() @ T_world_camera[:3, :3].T
    points = T_world_camera[:3, 3] + depth[..., None] * rays
    cells = np.floor(points[..., :2] / 0.08).astype(int)
    fine = (np.sin(cells[..., 0] * 12.9898 + cells[..., 1] * 78.233) * 43758.5453) % 1.0
    color = np.clip(color + checks * (fine[..., None] - 0.5), 0, 255)
    return color.astype(np.uint8), depth.astype(np.float32)


def _consistency(frame, view):
    grey = view[0].astype(np.float32) @ np.float32([0.299, 0.587, 0.114])
    return measure_photometric_consistency(*frame, grey, view[1], cutoff_m=10.0)


def test_a_frame_is_consistent_with_the_view_from_its_pose_only():
    frame = _view(np.eye(4))
    same = _consistency(frame, _view(np.eye(4)))
    assert same.overlap == same.inlier_ratio == 1
    assert same.correlation == pytest.approx(1, abs=1e-3)
    assert is_photometrically_consistent(same)
    # Along the wall: depth is the same there, the texture is not.
    tangent = np.cross([0.3, -0.2, -1.0], [0.0, 1.0, 0.0])
    along = make_pose(np.eye(3), 0.3 * tangent / np.linalg.norm(tangent))
    shifted = _consistency(frame, _view(along))
    assert shifted.inlier_ratio == 1
    assert shifted.correlation < 0.3
    assert not is_photometrically_consistent(shifted)
    ahead = _consistency(frame, _view(make_pose(np.eye(3), [0.0, 0.0, 0.3])))
    assert ahead.inlier_ratio < 0.05
    assert not is_photometrically_consistent(ahead)


def test_only_poses_from_which_the_map_looks_like_the_frame_are_verified():
    """Both frames are those from the first place; the second map is seen from beside it."""
    tangent = np.cross([0.3, -0.2, -1.0], [0.0, 1.0, 0.0])
    beside = make_pose(np.eye(3), 0.3 * tangent / np.linalg.norm(tangent))
    color, depth = (np.stack(pair) for pair in zip(*[_view(np.eye(4))] * 2, strict=True))
    views = [_view(pose) for pose in (np.eye(4), beside)]
    grey = np.stack(
        [view[0].astype(np.float32) @ np.float32([0.299, 0.587, 0.114]) for view in views]
    )
    vertices = np.zeros((2, *VIEW.shape, 3), dtype=np.float32)
    vertices[..., 2] = [view[1] for view in views]
    shown = SimpleNamespace(intensity=wp.array(grey), vertices=wp.array(vertices))
    aligner = SimpleNamespace(render=lambda poses: shown)
    ferns = FernRelocalization(2, VIEW, 10.0)
    poses, found = np.tile(np.eye(4), (2, 1, 1)), np.ones(2, dtype=bool)
    verified = ferns.verify(Images(color, depth), poses, found, aligner)
    assert verified.tolist() == [True, False]


def test_consistency_asks_neither_for_exposure_nor_for_texture():
    color, depth = _view(np.eye(4))
    dark = (0.5 * color + 10).astype(np.uint8)
    assert _consistency((dark, depth), (color, depth)).correlation > 0.98
    plain = np.full_like(color, 90)
    wall = _consistency((plain, depth), (plain, depth))
    assert wall.texture < 1
    assert wall.relief_m < 1e-3
    assert not is_photometrically_consistent(wall)  # any other wall looks the same
    relief, _, _ = ray_cast(np.eye(4), VIEW)
    box = relief.astype(np.float32)
    found = _consistency((plain, box), (plain, box))
    assert found.relief_m > 0.1
    assert is_photometrically_consistent(found)
    assert not is_photometrically_consistent(
        _consistency((plain, box * np.float32(1.1)), (plain, box))
    )
    assert not is_photometrically_consistent(
        _consistency((color, box), (plain, box))
    )  # the wrong texture


def _partly_off(offset_m: float, share: float):
    """The wall's frame and its view, whose lower rows are deeper by ``offset_m``."""
    color, depth = _view(np.eye(4))
    off = depth.copy()
    off[round((1 - share) * len(depth)) :] += np.float32(offset_m)
    return _consistency((color, off), (color, depth))


@pytest.mark.parametrize("share", [0.11, 0.19])
def test_a_seventh_of_the_depths_may_be_off(share):
    assert is_photometrically_consistent(_partly_off(0.5, share)) == (share < 0.15)


def test_a_slide_of_a_texture_cell_is_refused_by_its_correlation():
    """6 cm along a wall whose cells have 8: correlation 0.38."""
    tangent = np.cross([0.3, -0.2, -1.0], [0.0, 1.0, 0.0])
    beside = make_pose(np.eye(3), 0.06 * tangent / np.linalg.norm(tangent))
    found = _consistency(_view(np.eye(4)), _view(beside))
    assert found.correlation > 0.3
    assert not is_photometrically_consistent(found)


def test_a_depth_counts_as_the_same_within_its_noise():
    depths = _view(np.eye(4))[1]
    tolerance_m = 0.02 + 0.02 * depths**2
    assert _partly_off(0.9 * tolerance_m.min(), 1.0).inlier_ratio == 1
    assert _partly_off(1.4 * tolerance_m.max(), 1.0).inlier_ratio == 0


def test_a_blurred_noisy_frame_is_consistent_still(box_scene):
    """Correlation about 0.6, where a sharp frame without noise has 1."""
    sensor = RGBDSensor(box_scene, xtion("160x120"), noise="none")
    seen = sensor.capture(look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5]), 0)
    rng = np.random.default_rng(0)
    noisy = cv2.blur(seen.color, (1, 11)) + rng.normal(0, 6, seen.color.shape)
    found = _consistency(
        (np.clip(noisy, 0, 255).astype(np.uint8), seen.depth), (seen.color, seen.depth)
    )
    assert 0.5 < found.correlation < 0.75
    assert is_photometrically_consistent(found)


def test_what_does_not_overlap_is_not_consistent():
    color, depth = _view(np.eye(4))
    hidden = depth.copy()
    hidden[:, 20:] = 0
    found = _consistency((color, depth), (color, hidden))
    assert found.overlap == pytest.approx(0.25, abs=0.01)
    assert not is_photometrically_consistent(found)
    nothing = _consistency((color, np.zeros_like(depth)), (color, depth))
    assert nothing.overlap == 0
    assert not is_photometrically_consistent(nothing)
