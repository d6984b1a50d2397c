"""Fern codes against a slow, obvious version; the database of keyframes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.device_ferns import DeviceFernEncoder
from ms_slam_env.slam.shared.ferns import (
    MEAN_LEVEL,
    FernCode,
    FernConfig,
    FernDatabase,
    FernEncoder,
    dissimilarities,
)
from ms_slam_env.slam.shared.images import Images

CAMERA = xtion("160x120")


def _pose(angle_deg: float) -> np.ndarray:
    angle = np.radians(angle_deg)
    return look_at([0.0, 0.0, 1.3], [np.cos(angle), np.sin(angle), 0.9])


ANGLES = range(0, 180, 15)


@pytest.fixture(scope="module")
def frames(box_scene: BoxScene) -> list[RGBDFrame]:
    """Views about the room, 15 degrees apart."""
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=0)
    return [sensor.capture(_pose(angle), index) for index, angle in enumerate(ANGLES)]


@pytest.fixture
def database(frames) -> FernDatabase:
    found = FernDatabase(CAMERA, FernConfig(keyframe_dissimilarity=0.1), seed=3)
    for index, (frame, angle) in enumerate(zip(frames, ANGLES, strict=True)):
        assert found.observe(frame.color, frame.depth, _pose(angle), index)
    return found


def test_codes_are_those_of_a_slow_version(frames):
    config = FernConfig(num_ferns=60)
    encoder = FernEncoder(CAMERA, config, seed=5)
    frame = RGBDFrame(frames[0].color, frames[0].depth.copy())
    frame.depth[:, 100:] = 0
    # The same draws, one test after another.
    rng = np.random.default_rng(5)
    column, row = rng.integers(0, 40, 60), rng.integers(0, 30, 60)
    colors, depths = rng.uniform(32, 224, (60, 3)), rng.uniform(0.4, 3.0, 60)
    reduced = np.rint(frame.color.reshape(30, 4, 40, 4, 3).mean((1, 3))).astype(np.uint8)
    small = cv2.GaussianBlur(reduced, (0, 0), config.blur_px)
    gain = MEAN_LEVEL / small.mean()
    code = encoder.encode(frame.color, frame.depth)
    for fern in range(60):
        pixel = small[row[fern], column[fern]]
        depth = frame.depth[4 * row[fern] + 2, 4 * column[fern] + 2]
        bits = sum(1 << k for k in range(3) if gain * pixel[k] > colors[fern, k])
        bits += 8 * int(depth > depths[fern])
        assert code.bits[fern] == bits
        assert code.known[fern] == (15 if depth > 0 else 7)
    assert set(code.known) == {7, 15}


_CODES = st.builds(
    FernCode,
    arrays(np.uint8, 12, elements=st.integers(0, 15)),
    arrays(np.uint8, 12, elements=st.sampled_from([7, 15])),
)


def _between(a: FernCode, b: FernCode) -> float:
    return float(dissimilarities(a, b.bits[None], b.known[None])[0])


@given(_CODES, _CODES, _CODES)
def test_axioms_of_a_dissimilarity(a, b, c):
    assert _between(a, a) == 0
    assert _between(a, b) == _between(b, a)
    assert 0 <= _between(a, b) <= 1
    slow = 0
    for i in range(12):
        both = int(a.known[i]) & int(b.known[i])
        slow += (int(a.bits[i]) & both) != (int(b.bits[i]) & both)
    assert _between(a, b) == slow / 12
    if all((code.known == 15).all() for code in (a, b, c)):
        assert _between(a, c) <= _between(a, b) + _between(b, c) + 1e-12


def test_a_frame_finds_itself_and_its_neighbourhood(database, frames, box_scene):
    for index, frame in enumerate(frames):
        best = database.candidates(frame.color, frame.depth, 3)
        assert best[0].index == index
        assert best[0].time == index
        assert best[0].dissimilarity == 0
        assert [c.dissimilarity for c in best] == sorted(c.dissimilarity for c in best)
    sensor = RGBDSensor(box_scene, CAMERA, noise="kinect", seed=9)
    near = _pose(62) @ make_pose(so3_exp([0.03, 0, 0.03]), [0.04, 0.02, 0.03])
    frame = sensor.capture(near, 77)
    assert database.candidates(frame.color, frame.depth, 1)[0].index == 4  # 60 degrees


def test_exposure_hardly_changes_the_code(frames):
    encoder = FernEncoder(CAMERA, FernConfig(), seed=0)
    for frame in frames[:4]:
        code = encoder.encode(frame.color, frame.depth)
        darker = encoder.encode((0.5 * frame.color).astype(np.uint8), frame.depth)
        assert _between(code, darker) < 0.05


def test_what_resembles_a_keyframe_is_not_kept(database, frames):
    before = len(database)
    assert not database.observe(frames[2].color, frames[2].depth, np.eye(4))
    assert len(database) == before == len(frames)


def test_only_keyframes_before_a_time_are_found(database, frames):
    found = database.candidates(frames[6].color, frames[6].depth, 50, before=4)
    assert sorted(c.index for c in found) == [0, 1, 2, 3]
    assert database.candidates(frames[6].color, frames[6].depth, 50, before=0) == []


def test_a_black_frame_is_like_no_keyframe(database):
    black, nothing = np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32)
    assert database.candidates(black, nothing, 1)[0].dissimilarity > 0.5


def test_keyframes_move_with_the_map(database, frames):
    before = database.poses
    motion = make_pose(so3_exp([0.1, 0.2, -0.1]), [1.0, 2.0, 3.0])
    database.move(motion @ before)
    np.testing.assert_array_equal(database.poses, motion @ before)
    database.move(before)
    np.testing.assert_array_equal(database.poses, before)
    best = database.candidates(frames[1].color, frames[1].depth, 1)[0]
    np.testing.assert_array_equal(best.T_world_camera, before[1])


def test_state_goes_on_bit_exactly(database, frames):
    state = database.get_state()
    other = FernDatabase(CAMERA, FernConfig(keyframe_dissimilarity=0.1), seed=3)
    other.set_state(state)
    database.clear()
    assert len(database) == 0
    assert database.candidates(frames[0].color, frames[0].depth, 3) == []
    database.set_state(state)
    new = frames[0].color[::-1].copy(), frames[0].depth[::-1].copy()
    for one in (database, other):
        assert one.observe(*new, np.eye(4), 99)
        assert len(one) == len(frames) + 1
        assert one.candidates(*new, 1)[0].time == 99
        np.testing.assert_array_equal(one.times, [*range(len(frames)), 99])
    first, second = (
        one.candidates(frames[3].color, frames[3].depth, 20) for one in (database, other)
    )
    for a, b in zip(first, second, strict=True):
        assert (a.index, a.dissimilarity) == (b.index, b.dissimilarity)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    assert len(state["bits"]) == len(frames)


def test_many_keyframes_are_kept_in_order():
    database = FernDatabase(CAMERA, FernConfig(num_ferns=30, keyframe_dissimilarity=0.0))
    rng = np.random.default_rng(0)
    codes = [
        FernCode(rng.integers(0, 16, 30, dtype=np.uint8), np.full(30, 15, np.uint8))
        for _ in range(200)
    ]
    for time, code in enumerate(codes):
        assert database.observe_code(code, make_pose(np.eye(3), [time, 0.0, 0.0]), time)
    for time in (0, 63, 64, 150, 199):
        best = database.candidates_of(codes[time], 1)[0]
        assert (best.index, best.T_world_camera[0, 3]) == (time, time)


def test_bad_input_is_refused(database, frames):
    with pytest.raises(InputError, match="T_world_camera"):
        database.observe(frames[0].color, frames[0].depth, np.zeros((4, 4)))
    with pytest.raises(InputError, match="poses must have shape"):
        database.move(np.eye(4)[None])
    with pytest.raises(InputError, match="num_ferns"):
        FernConfig(num_ferns=0)
    with pytest.raises(InputError, match="near_m"):
        FernConfig(near_m=3.0, far_m=2.0)


@pytest.mark.parametrize(
    ("size", "blur_px", "exact"),
    [
        ("40x30", 1.0, True),
        ("80x60", 1.0, True),  # OpenCV rounds means of 2x2 otherwise than those of more
        ("160x120", 0.5, True),
        ("640x480", 2.5, True),  # every second pixel
        ("100x75", 1.0, False),  # no whole number of pixels for one
        ("160x120", 12.0, False),  # blurred over more than the image
    ],
)
def test_codes_are_the_same_on_the_device(frames, size, blur_px, exact):
    camera, rng = xtion(size), np.random.default_rng(1)
    color = np.stack(
        [cv2.resize(frame.color, (camera.width, camera.height)) for frame in frames[:3]]
        + [rng.integers(0, 256, (*camera.shape, 3), dtype=np.uint8)]
    )
    depth = rng.uniform(0, 4, color.shape[:3]).astype(np.float32)
    depth[depth < 1] = 0
    encoder = FernEncoder(camera, FernConfig(blur_px=blur_px), seed=2)
    assert encoder.tests.run_on_device == exact
    envs = np.array([3, 0, 2], dtype=np.int32)
    found = [encoder.encode_all(Images(color, depth), envs)]
    if exact:
        there = Images(wp.array(color, dtype=wp.uint8), wp.array(depth, dtype=wp.float32))
        on_device = DeviceFernEncoder(encoder.tests, len(color), "cpu")
        found += [FernCode(*on_device.encode(there, envs)) for _ in range(2)]
    for code in found:
        for n, env in enumerate(envs):
            alone = encoder.encode(color[env], depth[env])
            np.testing.assert_array_equal(code.bits[n], alone.bits)
            np.testing.assert_array_equal(code.known[n], alone.known)


def test_many_databases_keep_at_once_what_each_keeps_alone(frames):
    encoder = FernEncoder(CAMERA, FernConfig(), seed=3)
    together, alone = ([FernDatabase(CAMERA, seed=3) for _ in range(70)] for _ in range(2))
    rng, kept = np.random.default_rng(0), []
    for step in range(4):
        shown = rng.integers(0, len(frames), len(alone))
        codes = [encoder.encode(frames[k].color, frames[k].depth) for k in shown]
        poses = np.stack([_pose(ANGLES[k]) for k in shown])
        times = np.arange(step, step + len(alone), dtype=np.int32)
        stacked = FernCode(*(np.stack([getattr(c, n) for c in codes]) for n in ("bits", "known")))
        found = FernDatabase.observe_codes(together, stacked, poses, times)
        each = [
            database.observe_code(code, pose, int(time))
            for database, code, pose, time in zip(alone, codes, poses, times, strict=True)
        ]
        assert found.tolist() == each
        kept.append(np.mean(each))
    assert kept[0] == 1
    assert 0 < kept[-1] < 1
    for one, other in zip(together, alone, strict=True):
        for name, values in one.get_state().items():
            np.testing.assert_array_equal(values, other.get_state()[name])
