"""A lost camera goes on in a new submap, which is joined where the old one is seen again."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import (
    adjoint,
    invert,
    look_at,
    make_pose,
    relative_angle,
    se3_exp,
    se3_log,
    so3_exp,
    transform_points,
)
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.submap_frames import SubmapLedger
from ms_slam_env.slam.surfel.submaps import MapFinder
from ms_slam_env.slam.surfel.trajectory_history import DetachedMap

CAMERA = xtion("160x120")
OPTIONS = {"max_surfels": 120_000, "submaps": "atlas", "submap_rules": {"after": 3}}
EYE = np.array([-0.8, -0.8, 1.2])


def _looking(degrees: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of a camera that turns on the spot, stepping aside a little."""
    angles = np.radians(degrees)
    eyes = EYE + np.outer(degrees, [0.002, 0.003, 0.0])
    aims = np.stack([np.cos(angles), np.sin(angles), np.full(len(angles), -0.35)], axis=1)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, aims, strict=True)])


# The camera looks about, jumps to where it has never been, and comes back from there.
PATH = _looking(np.concatenate([np.arange(0, 46, 3), np.arange(130, 30, -3)]))
JUMP = 16  # first frame after it


@pytest.fixture(scope="module")
def sensor(box_scene: BoxScene) -> RGBDSensor:
    return RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)


@pytest.fixture(scope="module")
def frames(sensor) -> list[RGBDFrame]:
    return [sensor.capture(pose, index) for index, pose in enumerate(PATH)]


def _run(frames, start=PATH[0], **options):
    backend = slam.make("surfel", CAMERA, **{**OPTIONS, **options})
    backend.reset(start)
    return backend, [backend.track(frame) for frame in frames]


@pytest.fixture(scope="module")
def joined(frames):
    """The SLAM after the whole path, and its results."""
    return _run(frames)


def _errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_tracking_goes_on_in_a_new_submap_until_it_is_joined_to_the_old_one(joined):
    backend, results = joined
    lost = [k for k, result in enumerate(results) if not result.tracking_ok]
    assert lost == [JUMP, JUMP + 1]  # the third refused frame starts the submap
    labels = [result.submap for result in results]
    at = [result.submaps_joined for result in results].index(True)
    assert labels == [0] * (JUMP + 2) + [1] * (at - JUMP - 2) + [0] * (len(results) - at)
    summary = backend.submaps()
    assert summary.first_frames.tolist() == [0, JUMP + 2]
    assert summary.joined_to.tolist() == [0, 0]
    assert summary.joined_at.tolist() == [-1, at]
    # In the unjoined submap poses are as wrong as the guess; from the frame that joins it on right.
    estimates = np.stack([result.T_world_camera for result in results])
    errors = _errors(estimates, PATH)
    assert errors[JUMP + 2 : at].min() > 0.1
    assert errors[at:].max() < 0.01
    off = relative_angle(estimates[at, :3, :3], PATH[at, :3, :3])
    assert off < np.radians(0.5)


def test_the_segment_of_a_joined_submap_is_moved_by_the_found_transform(joined):
    backend, _ = joined
    numbers, poses = backend.corrected_trajectory()
    assert numbers.tolist() == list(range(JUMP + 2, len(PATH)))
    assert _errors(poses, PATH[numbers]).max() < 0.015
    # And its surfels, in the world of the first submap.
    points = backend.surface_points()
    walls = np.abs(points - np.clip(points, [-2, -2, 0], [2, 2, 2.5])).max(axis=1)
    assert np.quantile(walls, 0.99) < 0.03
    assert len(points) == len(backend.surface_colors())
    assert "submap" not in backend.map_attributes()


def test_an_unjoined_submap_says_how_unsure_it_is_and_keeps_the_old_map(frames):
    backend, results = _run(frames[: JUMP + 8])
    assert results[-1].submap == 1
    sure, unsure = (np.trace(results[k].covariance[:3, :3]) for k in (JUMP - 1, -1))
    assert unsure > 100 * sure
    drift = [np.trace(results[k].drift[:3, :3]) for k in (JUMP - 1, JUMP + 2, JUMP + 3)]
    assert 0 < drift[0] < drift[1] < drift[2]  # the map before is as far off, seen from elsewhere
    points, attributes = backend.surface_points(), backend.map_attributes()
    labels = attributes["submap"]
    assert len(points) == len(labels) == len(attributes["normal"])
    assert set(labels.tolist()) == {0, 1}
    alone, _ = _run(frames[:JUMP])
    np.testing.assert_array_equal(points[labels == 0], alone.surface_points())
    # Views show the present submap alone, although the old one lies in the same place by the guess.
    view, seen = backend.predict(results[-1].T_world_camera[None]).depth[0], frames[JUMP + 7].depth
    both = (view > 0) & (seen > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(view - seen)[both]) < 0.01


def test_a_guess_is_where_the_submap_starts(frames):
    backend = slam.make("surfel", CAMERA, **OPTIONS)
    backend.reset(PATH[0])
    for k, frame in enumerate(frames[: JUMP + 3]):
        result = backend.track(frame, PATH[k])
    assert result.submap == 1
    np.testing.assert_allclose(result.T_world_camera, PATH[JUMP + 2], atol=1e-12)
    guessed = backend.submaps().links[1]
    _, results = _run(frames[: JUMP + 3])
    assert np.trace(guessed) < np.trace(results[-1].covariance)


@pytest.mark.parametrize("stop", [JUMP + 1, JUMP + 4, -12])
def test_saved_states_go_on_bit_exactly(frames, joined, stop):
    """Before the submap starts, in it, and while looks are being collected."""
    whole, results = joined
    stop %= len(frames)
    first, _ = _run(frames[:stop])
    state = first.get_state()
    # Another one, that has been elsewhere in the meantime.
    other, _ = _run(frames[JUMP:][::-1][:25])
    other.set_state(state)
    for frame, expected in zip(frames[stop:], results[stop:], strict=True):
        result = other.track(frame)
        np.testing.assert_array_equal(result.T_world_camera, expected.T_world_camera)
        assert (result.submap, result.tracking_ok) == (expected.submap, expected.tracking_ok)
    np.testing.assert_array_equal(other.surface_points(), whole.surface_points())
    for one, two in zip(other.corrected_trajectory(), whole.corrected_trajectory(), strict=True):
        np.testing.assert_array_equal(one, two)


def test_without_a_loss_every_bit_is_as_without_submaps(frames):
    smooth = frames[JUMP:]
    (on, with_submaps), (off, without) = (
        _run(smooth, PATH[JUMP], submaps=variant) for variant in ("atlas", "off")
    )
    assert all(result.tracking_ok for result in without)
    for one, other in zip(with_submaps, without, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(on.surface_points(), off.surface_points())
    assert len(on.submaps()) == 1
    assert not len(on.corrected_trajectory()[0])


def test_frames_that_stay_out_of_the_map_start_another_where_features_put_them(frames):
    """No alignment can meet these rules, so that only features speak for the poses."""
    rules = {"overlap": 1.0}
    smooth = frames[JUMP : JUMP + 5]
    backend, results = _run(smooth, PATH[JUMP], acceptance=rules)
    assert [result.submap for result in results] == [0, 0, 0, 1, 1]
    assert [result.uncertain for result in results[:4]] == [False, True, True, False]
    for result, pose in zip(results, PATH[JUMP:], strict=False):
        assert np.linalg.norm(result.T_world_camera[:3, 3] - pose[:3, 3]) < 0.02
    doubt = [np.trace(result.covariance[:3, :3]) for result in results[1:]]
    assert doubt[1] > 1.5 * doubt[0]
    assert doubt[2] > doubt[1]  # of the submap's start
    link = backend.submaps().links[1]
    assert np.sqrt(np.trace(link[:3, :3])) >= 0.03 * np.sqrt(9) - 1e-9


def test_a_new_submap_and_searches_in_old_ones_know_the_noise(frames):
    backend, _ = _run(frames[:JUMP])
    usual, reference = backend._slam.noise()
    assert usual["cost"] < 1.0  # learnt
    backend._slam.restart(PATH[0])
    assert backend._slam.noise() == (usual, reference)
    finder = MapFinder(backend._slam)
    images = Images(frames[JUMP].color[None], frames[JUMP].depth[None])
    finder.near(images, backend._slam.detach_map(0), PATH[JUMP])
    assert finder._slam.noise() == (usual, reference)


def test_off_stands_still(frames):
    backend, results = _run(frames[: JUMP + 8], submaps="off")
    held = results[JUMP - 1].T_world_camera
    for result in results[JUMP:]:
        assert not result.tracking_ok
        np.testing.assert_array_equal(result.T_world_camera, held)
    assert len(backend.submaps()) == 1


def test_blank_frames_start_no_submap(frames):
    black = RGBDFrame(np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160), np.float32))
    backend, results = _run([*frames[:JUMP], *[black] * 10, frames[JUMP]])
    assert not any(result.tracking_ok for result in results[JUMP:])
    assert len(backend.submaps()) == 1


def test_another_room_is_not_joined(frames):
    """The same room with other textures: its shape alone must not be enough."""
    other = RGBDSensor(BoxScene(seed=7), CAMERA, noise="kinect", seed=3)
    elsewhere = [other.capture(pose, index) for index, pose in enumerate(PATH[JUMP:])]
    _, results = _run([*frames[:JUMP], *elsewhere])
    assert results[-1].submap == 1
    assert not any(result.submaps_joined for result in results)


def test_loop_closure_and_submaps_work_together(frames):
    loops = {"loop_closure": "deformation", "loops": {"window": 10}}
    backend, results = _run(frames, **loops)
    assert [result.submaps_joined for result in results].count(True) == 1
    numbers, poses = backend.corrected_trajectory()
    assert len(numbers) == len(PATH) - 2  # all but the refused ones
    assert _errors(poses, PATH[numbers]).max() < 0.015


# -- The ledger --------------------------------------------------------------------------------


def _random_pose(rng: np.random.Generator, size: float = 1.0) -> np.ndarray:
    return make_pose(so3_exp(rng.normal(size=3) * size), rng.normal(size=3) * size)


def test_the_covariance_of_a_submap_is_that_of_its_links_by_finite_differences():
    rng = np.random.default_rng(0)
    ledger = SubmapLedger()
    links = [np.diag(rng.uniform(1e-5, 1e-4, 6)) for _ in range(2)]
    starts = [_random_pose(rng) for _ in links]
    for frame, (start, link) in enumerate(zip(starts, links, strict=True)):
        ledger.start(10 * frame, start, link)
    pose, step = _random_pose(rng), 1e-6
    expected = np.zeros((6, 6))
    for start, link in zip(starts, links, strict=True):
        moved = [start @ se3_exp(step * axis) @ invert(start) @ pose for axis in np.eye(6)]
        jacobian = np.stack([se3_log(invert(pose) @ T) for T in moved], axis=1) / step
        expected += jacobian @ link @ jacobian.T
    np.testing.assert_allclose(ledger.covariance(2, pose), expected, atol=1e-8)


def test_joining_moves_what_hangs_on_the_newer_and_what_lies_between_in_part():
    rng = np.random.default_rng(1)
    ledger = SubmapLedger()
    poses = [_random_pose(rng) for _ in range(3)]
    for frame, (pose, sigma) in enumerate(zip(poses, (0.1, 0.2, 0.1), strict=True)):
        number = ledger.start(frame, pose, sigma**2 * np.eye(6))
        ledger.record(frame, number, pose)
    correction = se3_exp([0.06, 0, 0, 0, 0, 0])
    between = ledger.between(0, 3, correction)
    assert sorted(between) == [1, 2]
    shares = [between[k][0, 3] / 0.06 for k in (1, 2)]
    np.testing.assert_allclose(shares, [1 / 6, 5 / 6])  # variances 1, 4, 1
    ledger.join(0, 3, correction, 9)
    _, moved = ledger.trajectory()
    np.testing.assert_allclose(moved[2], correction @ poses[2])
    np.testing.assert_array_equal(moved[:2], poses[:2])
    assert ledger.summary().joined_to.tolist() == [0, 1, 2, 0]
    assert not ledger.covariance(3, poses[2]).any()


def test_the_adjoint_carries_twists_through_a_motion():
    rng = np.random.default_rng(2)
    T, twist = _random_pose(rng), rng.normal(size=6)
    carried = T @ se3_exp(twist) @ invert(T)
    np.testing.assert_allclose(se3_exp(adjoint(T) @ twist), carried, atol=1e-12)


# -- Maps as arrays ----------------------------------------------------------------------------


def _surfels(position: np.ndarray, confidence: float) -> dict[str, np.ndarray]:
    count = len(position)
    ones = np.ones(count, dtype=np.float32)
    return {
        "position": position.astype(np.float32),
        "normal": np.tile(np.float32([0, 0, -1]), (count, 1)),
        "color": np.zeros((count, 3), dtype=np.float32),
        "radius": 0.01 * ones,
        "confidence": confidence * ones,
        "created": np.arange(count, dtype=np.int32),
        "seen": np.arange(count, dtype=np.int32),
    }


def test_a_surface_that_both_maps_have_is_kept_once():
    rng = np.random.default_rng(3)
    plane = np.c_[rng.uniform(0, 1, (4000, 2)), np.full(4000, 2.0)]
    older = DetachedMap(_surfels(plane, 20.0))
    shifted = plane + np.array([0.7, 0.0, 0.004])
    newer = DetachedMap(_surfels(shifted, 3.0))
    merged = older.merged(newer, stable=10.0).surfels["position"]
    added = merged[len(plane) :]
    np.testing.assert_array_equal(merged[: len(plane)], older.surfels["position"])
    assert added[:, 0].min() > 0.98  # what the older has already is left out
    assert len(added) == pytest.approx((shifted[:, 0] > 1.0).sum(), rel=0.05)
    # Stable surfels are kept: they are worth something.
    stable = DetachedMap(_surfels(shifted, 15.0))
    assert len(older.merged(stable, stable=10.0).surfels["seen"]) == 8000


def test_a_map_moves_with_all_that_it_holds():
    rng = np.random.default_rng(4)
    T = _random_pose(rng)
    position = rng.normal(size=(50, 3))
    keyframes = {"poses": np.stack([_random_pose(rng) for _ in range(3)])}
    before = DetachedMap(_surfels(position, 1.0), keyframes, since=7)
    moved = before.moved(T)
    expected = transform_points(T, position)
    np.testing.assert_allclose(moved.surfels["position"], expected, atol=1e-5)
    np.testing.assert_allclose(moved.surfels["normal"][0], T[:3, :3] @ [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(moved.keyframes["poses"], T @ keyframes["poses"])
    resumed = before.resumed(20)
    np.testing.assert_array_equal(resumed.surfels["seen"], before.surfels["seen"] + 13)
