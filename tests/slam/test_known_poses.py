"""Poses from outside: a guess that tracking starts from, and frames fused at known poses."""

from __future__ import annotations

import numpy as np
import pytest
from arc import CAMERA, START, arc, black_frame
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.surfel import BatchedSurfelSlam, SurfelConfig
from ms_slam_env.slam.surfel.backend import SurfelSlam
from ms_slam_env.slam.surfel.localization import Localizer

CONFIG = SurfelConfig(max_surfels=60_000, depth_cutoff_m=4.0)
# 40 cm along the viewing direction and up, 30 degrees about a slanted axis
JUMP = START @ make_pose(so3_exp(np.radians([12.0, 20.0, 19.0])), [0.12, -0.1, 0.37])


@pytest.fixture(scope="module")
def frames(arc_frames: list[RGBDFrame]) -> list[RGBDFrame]:
    return arc_frames[:10]


@pytest.fixture(scope="module")
def jump_frame(box_scene: BoxScene) -> RGBDFrame:
    return RGBDSensor(box_scene, CAMERA, noise="kinect", seed=1).capture(JUMP, 0)


def _new() -> slam.SlamBackend:
    backend = slam.make("surfel", CAMERA, max_surfels=60_000, depth_cutoff_m=4.0)
    backend.reset(START)
    return backend


def _error_m(result: slam.TrackResult, truth: np.ndarray) -> float:
    return float(np.linalg.norm(result.T_world_camera[:3, 3] - truth[:3, 3]))


@pytest.fixture
def no_features(monkeypatch):
    """Only the expected pose and the guesses are tried: features would find the jump alone."""
    monkeypatch.setattr(Localizer, "_search_by_features", lambda self, alignment, frames: alignment)


@pytest.mark.usefixtures("no_features")
@pytest.mark.parametrize("lost_frames", [0, 2])
def test_a_guess_finds_a_jump_that_plain_tracking_loses(frames, jump_frame, lost_frames):
    for guess in (None, JUMP):
        backend = _new()
        backend.track(frames[0])
        for _ in range(lost_frames):
            assert not backend.track(black_frame(), JUMP).tracking_ok
        result = backend.track(jump_frame, guess)
        assert result.tracking_ok == (guess is not None), result.reason
    assert _error_m(result, JUMP) < 0.02
    assert result.relocalised == bool(lost_frames)
    assert backend.track(jump_frame).tracking_ok


def test_the_alignment_corrects_a_guess_that_is_a_little_off(frames, jump_frame):
    backend = _new()
    backend.track(frames[0])
    off = JUMP @ make_pose(so3_exp(np.radians([2.0, -3.0, 2.0])), [0.03, -0.02, 0.04])
    result = backend.track(jump_frame, off)
    assert result.tracking_ok, result.reason
    assert _error_m(result, JUMP) < 0.02


def test_wrong_guesses_do_no_harm(frames):
    rng = np.random.default_rng(0)
    plain, guided = _new(), _new()
    for frame, truth in zip(frames, arc(10), strict=True):
        wrong = truth @ make_pose(so3_exp(rng.uniform(-1, 1, 3)), rng.uniform(-0.6, 0.6, 3))
        result = guided.track(frame, wrong)
        assert result.tracking_ok, result.reason
        assert _error_m(result, truth) < _error_m(plain.track(frame), truth) + 0.002


def test_a_guess_does_not_make_a_frame_from_elsewhere_tracked(frames, box_scene):
    backend = _new()
    for frame in frames[:4]:
        backend.track(frame)
    elsewhere = look_at([-0.5, 0.5, 1.2], [-1.5, -1.5, 0.6])
    frame = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=1).capture(elsewhere, 0)
    for guess in (elsewhere, START, JUMP):
        assert not backend.track(frame, guess).tracking_ok


def test_the_first_frame_is_taken_at_the_pose_of_the_reset(frames):
    result = _new().track(frames[0], JUMP)
    np.testing.assert_array_equal(result.T_world_camera, START)


@pytest.mark.usefixtures("no_features")
def test_guesses_of_a_batch_are_those_of_its_envs_alone(frames, jump_frame):
    color = np.stack([jump_frame.color, frames[1].color, jump_frame.color])
    depth = np.stack([jump_frame.depth, frames[1].depth, jump_frame.depth])
    guesses = [JUMP, None, None]
    together = BatchedSurfelSlam(3, CAMERA, CONFIG)
    for env in range(3):
        together.reset(START, env)
    first = frames[0]
    together.track(np.stack([first.color] * 3), np.stack([first.depth] * 3))
    results = together.track(color, depth, guesses)
    assert [result.tracking_ok for result in results] == [True, True, False]
    after = together.track(color, depth)
    for env, guess in enumerate(guesses):
        alone = _new()
        alone.track(first)
        frame = RGBDFrame(color[env], depth[env])
        for again in (results[env], after[env]):
            single = alone.track(frame, guess)
            guess = None
            assert single.tracking_ok == again.tracking_ok
            np.testing.assert_array_equal(single.T_world_camera, again.T_world_camera)


def test_tracking_goes_on_from_fused_frames(frames):
    backend = _new()
    path = arc(10)
    backend.track(frames[0])
    backend.track(black_frame())
    for index in (5, 6):
        assert not backend.fuse(frames[index], path[index]).relocalised
    for index in (7, 8, 9):
        result = backend.track(frames[index])
        assert result.tracking_ok
        assert not result.relocalised
        assert _error_m(result, path[index]) < 0.008


def test_a_fused_frame_without_depth_leaves_the_map_to_start(frames):
    backend = _new()
    assert backend.fuse(black_frame(), START).tracking_ok
    assert len(backend.surface_points()) == 0
    np.testing.assert_array_equal(backend.track(frames[0]).T_world_camera, START)


def test_bad_poses_are_refused(frames):
    backend = _new()
    for bad in (np.eye(3), np.full((4, 4), np.nan), 2 * np.eye(4), "here"):
        with pytest.raises(InputError, match="T_world_camera_guess"):
            backend.track(frames[0], bad)
        with pytest.raises(InputError, match="T_world_camera"):
            backend.fuse(frames[0], bad)
    batched = BatchedSurfelSlam(1, CAMERA, CONFIG)
    color, depth = frames[0].color[None], frames[0].depth[None]
    with pytest.raises(InputError, match="must hold 1 poses"):
        batched.track(color, depth, [None, None])
    with pytest.raises(InputError, match=r"shape \(1, 4, 4\), got \(4, 4\)"):
        batched.fuse(color, depth, START)
    with pytest.raises(InputError, match="depth holds"):
        batched.fuse(color, np.full_like(depth, np.nan), START[None])
    assert len(backend.surface_points()) == 0


def test_what_only_maps_takes_no_error_of_a_pose_for_motion(box_scene: BoxScene):
    """Frames of a still room, fused beside where they were taken as a poor odometry would."""
    sensor = RGBDSensor(box_scene, xtion("80x60"), noise="none")
    start = box_scene.sample_start(np.random.default_rng(0))
    frame = sensor.capture(start, 0)
    masked = {}
    for config in (SurfelConfig(max_surfels=50_000), SurfelConfig.of_mapper(max_surfels=50_000)):
        system = SurfelSlam(xtion("80x60"), config)
        system.reset(start)
        for k in range(20):
            beside = start @ make_pose(np.eye(3), [0.0, 0.0, 0.1 * (k % 5 == 4)])
            moving = system.fuse(frame, beside).moving
            masked[config.motion_mask] = max(
                masked.get(config.motion_mask, 0.0), 0.0 if moving is None else moving.mean()
            )
    assert masked["geometric"] > 0.05
    assert masked["none"] == 0.0
    for name in ("odometry", "sparse"):
        backend = slam.make(name, xtion("80x60"))
        backend.reset(start)
        backend.track(frame)
        assert backend._mapper.config.motion_mask == "none"
