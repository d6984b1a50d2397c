"""The sparse backend as a whole: loops, getting lost, bad input, GTSAM being absent."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, make_pose, relative_angle, se3_exp, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.state_check import check_like
from ms_slam_env.slam.sparse import SparseConfig, SparseSlam

CAMERA = xtion("160x120")
OPEN = 34  # frames of the turn before it meets its beginning
START = look_at([-0.8, -0.8, 1.2], [1.2, 0.1, 0.5])


@pytest.fixture(autouse=True)
def _gtsam():
    pytest.importorskip("gtsam", reason="GTSAM is not installed", exc_type=ImportError)


def _turn(steps: int, degrees: float) -> np.ndarray:
    """A camera that turns on the spot about the vertical, and moves a little."""
    turn = make_pose(so3_exp([0, 0, np.radians(degrees)]), [0, 0, 0])
    poses = [look_at([0.1, 0.0, 1.2], [1.5, 0.3, 0.7])]
    for _ in range(steps):
        poses.append(turn @ poses[-1])
    return np.stack(poses)


def _frames(scene: BoxScene, poses: np.ndarray) -> list[RGBDFrame]:
    sensor = RGBDSensor(scene, CAMERA, noise="kinect", seed=0)
    return [sensor.capture(pose, index) for index, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def circle(box_scene: BoxScene) -> tuple[np.ndarray, list[RGBDFrame]]:
    """A full turn of the camera and a little more, 9 degrees a frame."""
    poses = _turn(43, 9.0)
    return poses, _frames(box_scene, poses)


@pytest.fixture(scope="module")
def before_the_loop(circle) -> dict[str, Any]:
    """The state after three quarters of the turn; tests only look at it."""
    pytest.importorskip("gtsam", reason="GTSAM is not installed", exc_type=ImportError)
    poses, frames = circle
    backend = SparseSlam(CAMERA)
    backend.reset(poses[0])
    assert all(backend.track(frame).tracking_ok for frame in frames[:OPEN])
    assert backend.loops_closed == 0
    return backend.get_state()


def _errors_m(results: list[slam.TrackResult], poses: np.ndarray) -> np.ndarray:
    estimates = np.stack([result.T_world_camera for result in results])
    return np.linalg.norm(estimates[:, :3, 3] - poses[: len(results), :3, 3], axis=1)


def _close(
    circle: tuple[np.ndarray, list[RGBDFrame]], state: dict[str, Any], loops: bool
) -> tuple[SparseSlam, np.ndarray]:
    """The backend after the rest of the turn, and the errors of the frames in it.

    Every loop is stated by the frame that closed it, as it truly is.
    """
    poses, frames = circle
    backend = SparseSlam(CAMERA, SparseConfig(loops=loops))
    backend.set_state(state)
    results = [backend.track(frame) for frame in frames[OPEN:]]
    assert all(result.tracking_ok for result in results)
    stated = [(k, result.loop) for k, result in enumerate(results, OPEN) if result.loop]
    assert len(stated) == backend.loops_closed
    for k, loop in stated:
        assert loop.reference < OPEN
        error = invert(poses[k]) @ poses[loop.reference] @ loop.T_reference_camera
        assert np.linalg.norm(error[:3, 3]) < 0.02
        assert relative_angle(error[:3, :3], np.eye(3)) < np.radians(1.0)
        assert results[k - OPEN].loop_closed == loop.bent
    return backend, _errors_m(results, poses[OPEN:])


def _bent(state: dict[str, Any]) -> dict[str, Any]:
    """The state as if every keyframe had added 0.06 degrees and a fifth of a millimetre."""
    backend = SparseSlam(CAMERA)
    backend.set_state(state)
    sparse_map = backend.sparse_map
    bent = {
        k: keyframe.T_world_camera @ se3_exp(k * np.array([2e-4, 0, 0, 0, 1e-3, 0]))
        for k, keyframe in enumerate(sparse_map.keyframes)
    }
    sparse_map.move(bent)
    return {**backend.get_state(), "pose": bent[len(bent) - 1].copy()}


def test_a_full_turn_closes_a_loop(circle, before_the_loop):
    state = _bent(before_the_loop)
    closed, errors = _close(circle, state, loops=True)
    opened, _ = _close(circle, state, loops=False)
    assert closed.loops_closed > 0
    assert opened.loops_closed == 0
    assert errors[-1] < 0.02
    first, last = closed.sparse_map.keyframes[0], closed.sparse_map.keyframes[-1]
    assert len(np.intersect1d(first.seen_points(), last.seen_points())) > 10
    # Every frame became a keyframe: its true pose is known.
    truth = circle[0]
    turned = {}
    for name, backend in (("closed", closed), ("open", opened)):
        keyframes = backend.sparse_map.keyframes[:OPEN]
        assert len(keyframes) == OPEN
        turned[name] = [
            relative_angle(keyframe.T_world_camera[:3, :3], pose[:3, :3])
            for keyframe, pose in zip(keyframes, truth, strict=False)
        ]
    assert turned["open"][-1] > 0.02
    assert turned["closed"][-1] < 0.5 * turned["open"][-1]
    assert np.mean(turned["closed"]) < 0.6 * np.mean(turned["open"])


def test_a_map_with_closed_loops_is_gone_on_from_bit_exactly(circle, before_the_loop, tmp_path):
    closed, _ = _close(circle, before_the_loop, loops=True)
    closed.save(tmp_path / "map.npz")
    other = slam.open_map(tmp_path / "map.npz", lost=False)
    assert isinstance(other, SparseSlam)
    assert other.loops_closed == closed.loops_closed > 0
    for frame in circle[1][5:8]:
        one, two = closed.track(frame), other.track(frame)
        np.testing.assert_array_equal(one.T_world_camera, two.T_world_camera)
    np.testing.assert_array_equal(closed.surface_points(), other.surface_points())


def _refused(state: dict[str, Any], part: str, **changes: Any) -> str:
    """What is said of a state with other values in its part ``map``, or in a keyframe of it."""
    backend = SparseSlam(CAMERA)
    of_map = dict(state["map"])
    if part == "map":
        of_map |= changes
    else:
        of_map["keyframes"] = [*of_map["keyframes"][:-1], of_map["keyframes"][-1] | changes]
    with pytest.raises(InputError) as caught:
        check_like({**state, "map": of_map}, backend.state_like(), "slam")
    return str(caught.value)


def test_links_between_points_and_keyframes_are_checked(before_the_loop):
    state = before_the_loop
    check_like(state, SparseSlam(CAMERA).state_like(), "slam")
    of_map, last = state["map"], state["map"]["keyframes"][-1]
    points, keyframes = len(of_map["positions"]), len(of_map["keyframes"])
    for name in ("positions", "descriptors", "hosts", "host_features", "alive", "tried", "found"):
        for values in (of_map[name][:0], of_map[name][1:], np.repeat(of_map[name], 2, axis=0)):
            assert "in place of" in _refused(state, "map", **{name: values})
    for name, most in (("hosts", keyframes), ("host_features", 2**40), ("tried", 2**40)):
        for value in (-1, most):
            assert "counts to" in _refused(state, "map", **{name: np.full(points, value)})
    fewest = min(len(one["pixels"]) for one in of_map["keyframes"])
    strange = np.full(points, fewest)
    assert "do not have" in _refused(state, "map", host_features=strange)
    doubled = of_map["keyframes"] * 1000
    assert "not in the order of frame" in _refused(state, "map", keyframes=doubled)
    features = len(last["pixels"])
    for value in (-2, points):
        ids = np.full(features, value)
        assert "counts to" in _refused(state, "keyframe", point_ids=ids)
    assert "in place of" in _refused(state, "keyframe", pixels=last["pixels"][1:])
    assert "in place of" in _refused(state, "keyframe", depth=last["depth"][1:])
    assert "counts to" in _refused(state, "keyframe", depth=-last["depth"])
    assert "than it has counted" in _refused(state, "keyframe", frame=1000)
    assert "not a list" in _refused({**state, "dense": {**state["dense"], "poses": ()}}, "map")
    for reference in (-1, keyframes):
        assert "outside" in _refused({**state, "reference": reference}, "map")


def test_a_kidnapped_camera_is_found_in_the_map(box_scene, circle, before_the_loop):
    poses, _ = circle
    backend = SparseSlam(CAMERA)
    backend.set_state(before_the_loop)
    black = RGBDFrame(np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32))
    assert not backend.track(black).tracking_ok
    place = poses[5] @ make_pose(so3_exp([0.02, 0.03, 0.05]), [0.05, -0.03, 0.02])
    result = backend.track(_frames(box_scene, place[None])[0])
    assert result.tracking_ok, result.reason
    assert result.relocalised
    assert np.linalg.norm(result.T_world_camera[:3, 3] - place[:3, 3]) < 0.02
    assert relative_angle(result.T_world_camera[:3, :3], place[:3, :3]) < np.radians(0.7)


def test_known_poses_are_left_alone(box_scene):
    poses = _turn(5, 8.0)
    backend = SparseSlam(CAMERA)
    backend.reset(poses[0])
    for frame, pose in zip(_frames(box_scene, poses), poses, strict=True):
        backend.fuse(frame, pose)
    kept = [keyframe.T_world_camera for keyframe in backend.sparse_map.keyframes]
    np.testing.assert_array_equal(np.stack(kept), poses)


def test_looking_at_the_map_changes_nothing(circle):
    poses, frames = circle
    looked, blind = SparseSlam(CAMERA), SparseSlam(CAMERA)
    for backend in (looked, blind):
        backend.reset(poses[0])
    for frame in frames[:8]:
        looked.track(frame)
        looked.surface_points()
        blind.track(frame)
    np.testing.assert_array_equal(looked.surface_points(), blind.surface_points())
    np.testing.assert_array_equal(looked.predict(poses[:1]).depth, blind.predict(poses[:1]).depth)


def _blank(depth_m: float) -> RGBDFrame:
    """A wall without texture, straight ahead."""
    color = np.full((*CAMERA.shape, 3), 120, dtype=np.uint8)
    return RGBDFrame(color, np.full(CAMERA.shape, depth_m, dtype=np.float32))


def test_a_blank_wall_is_no_place_to_start():
    backend = SparseSlam(CAMERA)
    for _ in range(3):
        result = backend.track(_blank(1.5))
        assert not result.tracking_ok
        assert "0 corners with depth" in result.reason
    assert len(backend.surface_points()) == 0


def test_before_a_blank_wall_tracking_is_lost_not_drifting(box_scene, circle):
    poses, frames = circle
    backend = SparseSlam(CAMERA)
    backend.reset(poses[0])
    for frame in frames[:4]:
        held = backend.track(frame)
    for depth_m in (1.5, 1.45, 1.4):
        result = backend.track(_blank(depth_m))
        assert not result.tracking_ok
        assert "corners match the map" in result.reason
        np.testing.assert_array_equal(result.T_world_camera, held.T_world_camera)
    back = backend.track(frames[4])
    assert back.tracking_ok
    assert back.relocalised


def test_parameters_are_checked():
    for name, value in (
        ("features", 5),
        ("levels", 0),
        ("depth_cutoff_m", float("nan")),
        ("window", 1),
        ("loops", 1),
        ("max_surfels", 3.5),
    ):
        with pytest.raises(InputError, match=f"SparseConfig.{name}"):
            slam.make("sparse", CAMERA, **{name: value})


def test_without_gtsam_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(InputError, match=r"pip install 'ms-slam-env\[gtsam\]'") as error:
        slam.make("sparse", CAMERA)
    assert "\n" not in str(error.value)
