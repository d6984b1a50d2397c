"""Perturbations of rendered sequences: identities, closed forms, and the same result each time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, se3_exp, so3_exp
from ms_slam_env.sensor import NoiseConfig, RGBDSensor
from ms_slam_env.sequences import (
    PERTURBATIONS,
    AutoExposure,
    BlackFrames,
    DepthDropout,
    DepthQuantisation,
    ExposureJumps,
    ExposureRamp,
    FrameSkipping,
    Misregistration,
    MotionBlur,
    PoseInterpolation,
    RollingShutter,
    handheld_trajectory,
    make_perturbation,
    render_sequence,
)
from ms_slam_env.sequences.perturbations import Moment
from ms_slam_env.sequences.perturbations.optics import LinearLight, linear_of_srgb, srgb_of_linear

K = xtion("80x60")
FRAMES = 6


def moment(index: int = 3, count: int = 10, brightness: object = None) -> Moment:
    return Moment(index, count, index / 30, K, 5, brightness or (lambda: np.ones(count)))


def some_frame(seed: int = 0) -> RGBDFrame:
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (*K.shape, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 4.0, K.shape).astype(np.float32)
    depth[:5] = 0
    return RGBDFrame(color, depth, 0.1)


def same(a: RGBDFrame, b: RGBDFrame) -> bool:
    return (
        np.array_equal(a.color, b.color)
        and np.array_equal(a.depth, b.depth)
        and a.timestamp == b.timestamp
    )


@pytest.fixture(scope="module")
def path(box_scene: BoxScene) -> np.ndarray:
    return handheld_trajectory(box_scene, FRAMES, 1, speed_m=0.04, rot_deg=2.0)


# ---------------------------------------------------------------- poses between samples


@given(st.integers(0, 1000))
def test_poses_between_two_samples(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.stack([se3_exp(rng.normal(0, 0.5, 6)) for _ in range(4)])
    times = np.cumsum(rng.uniform(0.01, 0.1, 4))
    path = PoseInterpolation(times, poses)
    np.testing.assert_array_equal(path(times), poses)
    t = rng.uniform(times[0], times[-1], (3, 2))
    R = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(t.ravel()).as_matrix()
    np.testing.assert_allclose(path(t)[..., :3, :3].reshape(-1, 3, 3), R, atol=1e-12)
    x = [np.interp(t, times, poses[:, k, 3]) for k in range(3)]
    np.testing.assert_allclose(path(t)[..., :3, 3], np.stack(x, -1), atol=1e-12)
    beyond = path([times[-1] + 0.01, times[0] - 0.01])
    last = (poses[-1, :3, 3] - poses[-2, :3, 3]) / (times[-1] - times[-2])
    np.testing.assert_allclose(beyond[0, :3, 3], poses[-1, :3, 3] + 0.01 * last)
    for T in beyond:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_single_pose_stands_still() -> None:
    T = se3_exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_array_equal(PoseInterpolation([2.0], T[None])([1.0, 3.0]), [T, T])


@pytest.mark.parametrize(
    ("times", "poses", "message"),
    [
        ([0.0, 0.0], np.stack([np.eye(4)] * 2), "must be finite and increase"),
        ([0.0, np.nan], np.stack([np.eye(4)] * 2), "must be finite and increase"),
        ([0.0], np.stack([np.eye(4)] * 2), "do not fit poses"),
        ([], np.zeros((0, 4, 4)), "do not fit poses"),
        ([0.0, 1.0], np.stack([np.eye(4), np.full((4, 4), np.nan)]), "pose 1 of the trajectory"),
    ],
)
def test_bad_trajectories_are_refused(times, poses, message) -> None:
    with pytest.raises(InputError, match=message):
        PoseInterpolation(times, poses)


# ---------------------------------------------------------------- rolling shutter


def test_a_rolling_shutter_at_rest_is_the_plain_frame(box_scene: BoxScene) -> None:
    still = np.repeat(box_scene.sample_start(np.random.default_rng(2))[None], 3, axis=0)
    plain = render_sequence(box_scene, still, K, seed=4)
    rolling = render_sequence(box_scene, still, K, seed=4, perturbations=[RollingShutter(0.03)])
    assert all(same(a, b) for a, b in zip(plain.frames, rolling.frames, strict=True))


@pytest.mark.parametrize("height", [60, 59])
def test_a_row_is_that_of_a_frame_from_the_pose_of_the_row(
    box_scene: BoxScene, path: np.ndarray, height: int
) -> None:
    camera = dataclasses.replace(K, height=height)
    shutter = RollingShutter(0.03)
    rolling = render_sequence(box_scene, path, camera, "none", perturbations=[shutter])
    frame = rolling.frames[2]
    sensor = RGBDSensor(box_scene, camera, noise="none")
    between = PoseInterpolation(np.arange(FRAMES) / 30, path)
    for row in (0, 1, 26, 27, height - 1):
        first = row - row % 2
        centre = (first + min(first + 1, height - 1)) / 2
        T = between(2 / 30 + 0.03 * ((centre + 0.5) / height - 0.5))
        expected = sensor.capture(T, 2)
        np.testing.assert_array_equal(frame.color[row], expected.color[row])
        np.testing.assert_array_equal(frame.depth[row], expected.depth[row])
    plain = render_sequence(box_scene, path, camera, "none").frames[2]
    assert not np.array_equal(frame.depth, plain.depth)


def test_a_rolling_image_needs_its_number_of_poses(box_scene: BoxScene) -> None:
    sensor = RGBDSensor(box_scene, K)
    with pytest.raises(InputError, match=r"60 rows needs poses \(30, 4, 4\)"):
        sensor.capture_rolling(np.stack([np.eye(4)] * 29), 0)
    with pytest.raises(InputError, match="not finite"):
        sensor.capture_rolling(np.full((30, 4, 4), np.nan), 0)


# ---------------------------------------------------------------- motion blur


def test_blur_at_rest_without_noise_is_the_plain_frame(box_scene: BoxScene) -> None:
    still = np.repeat(box_scene.sample_start(np.random.default_rng(2))[None], 2, axis=0)
    plain = render_sequence(box_scene, still, K, "none").frames[1]
    blurred = render_sequence(box_scene, still, K, "none", perturbations=[MotionBlur()])
    assert same(plain, blurred.frames[1])


def test_blur_is_the_mean_of_the_light(box_scene: BoxScene, path: np.ndarray) -> None:
    blurred = render_sequence(box_scene, path, K, "none", perturbations=[MotionBlur(0.03, 3)])
    sensor = RGBDSensor(box_scene, K, noise="none")
    poses = PoseInterpolation(np.arange(FRAMES) / 30, path)(3 / 30 + np.array([-0.01, 0, 0.01]))
    light = np.mean([linear_of_srgb(sensor.capture(T, 0).color / 255) for T in poses], axis=0)
    frame = blurred.frames[3]
    np.testing.assert_array_equal(frame.color, np.rint(255 * srgb_of_linear(light)))
    plain = render_sequence(box_scene, path, K, "none").frames[3]
    np.testing.assert_array_equal(frame.depth, plain.depth)

    def detail(image: np.ndarray) -> float:
        return np.abs(np.diff(intensity_image(image).astype(float), axis=1)).mean()

    assert detail(frame.color) < detail(plain.color)


def test_blurred_colour_has_the_sensor_s_noise() -> None:
    noise = NoiseConfig(shot=4e-4, read=3e-3)
    level = 0.5
    value = np.uint8(round(255 * float(srgb_of_linear(np.array(level)))))
    exact = float(linear_of_srgb(np.array(value / 255)))
    images = np.full((4, 200, 200, 3), value)
    result = LinearLight(noise).mean(images, np.random.default_rng(0))
    light = linear_of_srgb(result / 255)
    expected = np.sqrt(noise.read**2 + noise.shot * exact)
    assert light.mean() == pytest.approx(exact, abs=1e-4)
    assert light.std() == pytest.approx(expected, rel=0.02)


# ---------------------------------------------------------------- misregistration


def test_misregistration_of_nothing_is_the_identity(box_scene: BoxScene, path) -> None:
    plain = render_sequence(box_scene, path, K, seed=3)
    off = Misregistration(focal_ratio=1.0, baseline_m=0.0)
    same_again = render_sequence(box_scene, path, K, seed=3, perturbations=[off])
    assert all(same(a, b) for a, b in zip(plain.frames, same_again.frames, strict=True))


def test_misregistered_colour_is_that_of_the_other_camera(box_scene: BoxScene, path) -> None:
    off = Misregistration(0.9, 0.025, 2.0, -1.5)
    frame = render_sequence(box_scene, path, K, "none", perturbations=[off]).frames[1]
    color = Intrinsics(0.9 * K.fx, 0.9 * K.fy, K.cx + 2.0, K.cy - 1.5, K.width, K.height)
    T = path[1] @ make_pose(np.eye(3), [0.025, 0, 0])
    expected = RGBDSensor(box_scene, color, noise="none").capture(T, 1)
    np.testing.assert_array_equal(frame.color, expected.color)
    depth = RGBDSensor(box_scene, K, noise="none").capture(path[1], 1).depth
    np.testing.assert_array_equal(frame.depth, depth)


# ---------------------------------------------------------------- exposure


@given(st.floats(0.3, 3.0), st.floats(-60, 60))
def test_gain_and_bias_are_undone_where_not_saturated(gain: float, bias: float) -> None:
    frame = some_frame()
    changed = ExposureRamp(gain, bias).apply(frame, moment(9, 10))
    values = changed.color.astype(float)
    inside = (values > 0) & (values < 255)
    recovered = (values - bias) / gain
    assert np.abs(recovered - frame.color)[inside].max(initial=0) <= 0.5 / gain + 1e-3
    np.testing.assert_array_equal(changed.depth, frame.depth)


def test_a_ramp_starts_with_nothing_and_is_linear() -> None:
    ramp = ExposureRamp(0.5, 20.0)
    assert ramp.gain_and_bias(moment(0, 11)) == (1.0, 0.0)
    assert ramp.gain_and_bias(moment(5, 11)) == pytest.approx((0.75, 10.0))
    assert ramp.gain_and_bias(moment(10, 11)) == pytest.approx((0.5, 20.0))
    assert same(ramp.apply(some_frame(), moment(0, 11)), some_frame())


def test_jumps_are_held_and_bounded() -> None:
    jumps = ExposureJumps(gain=1.5, bias=10, every=4, seed=1)
    values = [jumps.gain_and_bias(moment(k, 400)) for k in range(400)]
    assert values[:4] == [(1.0, 0.0)] * 4
    assert values[4:8] == [values[4]] * 4 != [(1.0, 0.0)] * 4
    gains, biases = np.array(values).T
    assert 1 / 1.5 <= gains.min() < 0.75
    assert 1.35 < gains.max() <= 1.5
    assert -10 <= biases.min() < -8
    assert 8 < biases.max() <= 10
    assert values != [dataclasses.replace(jumps, seed=2).gain_and_bias(moment(k)) for k in range(9)]


def test_auto_exposure_settles_where_the_mean_is_back() -> None:
    mean = np.array([100.0] * 5 + [50.0] * 60)
    control = AutoExposure(strength=1.0, rate=0.2)
    gains = [control.gain_and_bias(moment(k, 65, lambda: mean))[0] for k in range(65)]
    assert gains[:5] == [1.0] * 5
    assert all(np.diff(gains[4:]) > 0)
    assert gains[-1] == pytest.approx(2.0, abs=1e-4)
    assert np.log(gains[6]) == pytest.approx((1 - 0.8**2) * np.log(2))
    assert AutoExposure(0.0).gain_and_bias(moment(60, 65, lambda: mean)) == (1.0, 0.0)


def test_auto_exposure_goes_by_what_is_seen(box_scene: BoxScene, path) -> None:
    sequence = render_sequence(box_scene, path, K, "none", perturbations=[AutoExposure(rate=1.0)])
    plain = render_sequence(box_scene, path, K, "none")
    means = [intensity_image(f.color).mean() for f in plain.frames]
    controlled = [intensity_image(f.color).mean() for f in sequence.frames]
    assert np.ptp(controlled) < 0.5 * np.ptp(means)


# ---------------------------------------------------------------- black frames, holes, steps


def test_black_frames() -> None:
    runs = BlackFrames(start=4, length=2, every=10)
    black = [k for k in range(30) if not runs.apply(some_frame(), moment(k, 30)).color.any()]
    assert black == [4, 5, 14, 15, 24, 25]
    assert not runs.apply(some_frame(), moment(5)).depth.any()
    assert same(runs.apply(some_frame(), moment(6)), some_frame())
    assert same(BlackFrames(0, 0).apply(some_frame(), moment(0)), some_frame())


def test_holes_have_the_stated_extent() -> None:
    depth = np.full(K.shape, 2.0, dtype=np.float32)
    depth[:, :40] = 1.0
    frame = RGBDFrame(np.zeros((*K.shape, 3), np.uint8), depth)
    edges = DepthDropout(patches=0, edge_px=2, pixels=0).apply(frame, moment())
    gone = np.flatnonzero((edges.depth == 0).all(axis=0))
    np.testing.assert_array_equal(gone, [38, 39, 40, 41])
    assert (edges.depth == 0).sum() == 4 * K.height
    singles = DepthDropout(patches=0, edge_px=0, pixels=0.2).apply(frame, moment())
    assert (singles.depth == 0).mean() == pytest.approx(0.2, abs=0.03)
    patches = DepthDropout(patches=0.3, edge_px=0, pixels=0).apply(frame, moment())
    assert 0.3 <= (patches.depth == 0).mean() < 0.45
    assert same(DepthDropout(0, 0.1, 0, pixels=0).apply(frame, moment()), frame)
    other = DepthDropout(patches=0.3, edge_px=0, pixels=0).apply(frame, moment(4))
    assert not np.array_equal(other.depth, patches.depth)


@given(st.floats(0.02, 1.0))
def test_quantised_depth_has_whole_disparities(step: float) -> None:
    frame = some_frame()
    quantised = DepthQuantisation(step).apply(frame, moment()).depth
    read = frame.depth > 0
    assert ((quantised > 0) == read).all()
    unit = 570.3 * 0.075 / step
    steps = unit / quantised[read].astype(float)
    np.testing.assert_allclose(steps, np.rint(steps), rtol=1e-6)
    assert np.abs(unit / frame.depth[read] - np.rint(steps)).max() <= 0.5 + 1e-6
    assert same(DepthQuantisation(0.0).apply(frame, moment()), frame)


def test_skipped_frames(box_scene: BoxScene, path) -> None:
    sequence = render_sequence(box_scene, path, K, perturbations=[FrameSkipping(2)])
    plain = render_sequence(box_scene, path, K)
    assert len(sequence) == 3
    np.testing.assert_array_equal(sequence.poses, path[::2])
    assert all(same(sequence.frames[k], plain.frames[2 * k]) for k in range(3))
    kept = FrameSkipping(1, lost=0.3, seed=2).keep(2000, 1)
    assert kept[0] == 0
    assert len(kept) == pytest.approx(1400, abs=80)
    np.testing.assert_array_equal(kept, FrameSkipping(1, lost=0.3, seed=2).keep(2000, 1))
    np.testing.assert_array_equal(FrameSkipping(1).keep(5, 0), np.arange(5))


# ---------------------------------------------------------------- all of them


def test_every_frame_is_a_function_of_its_index(box_scene: BoxScene, path) -> None:
    everything = [make_perturbation(name) for name in PERTURBATIONS]
    make = lambda seed: render_sequence(  # noqa: E731
        box_scene, path, K, seed=seed, perturbations=everything
    )
    first = list(make(7))
    assert 2 <= len(first) <= FRAMES // 2  # every second one, and a hurried path has fewer
    again = make(7)
    backwards = [again.frames[k] for k in reversed(range(len(again)))][::-1]
    for (frame, T), other, pose in zip(first, backwards, again.poses, strict=True):
        assert same(frame, other)
        np.testing.assert_array_equal(T, pose)
    assert not np.array_equal(first[0][0].depth, make(8).frames[0].depth)


@pytest.mark.parametrize("name", PERTURBATIONS)
def test_each_changes_something(name: str, box_scene: BoxScene, path) -> None:
    options = {"black-frames": {"start": 2}, "exposure-jumps": {"every": 1}}.get(name, {})
    sequence = render_sequence(box_scene, path, K, perturbations=[make_perturbation(name, options)])
    plain = render_sequence(box_scene, path, K)
    assert len(sequence) != len(plain) or any(
        not same(a, b) for a, b in zip(sequence.frames, plain.frames, strict=True)
    )


def test_truth_is_what_an_ideal_camera_sees(box_scene: BoxScene, path) -> None:
    in_the_world = ("moving-objects", "fast-motion")  # what there is to see, and from where
    everything = [make_perturbation(name) for name in PERTURBATIONS if name not in in_the_world]
    truth = render_sequence(box_scene, path, K, perturbations=everything).frames.truth(1)
    expected = RGBDSensor(box_scene, K, noise="none").ground_truth(path[2])
    np.testing.assert_array_equal(truth.depth, expected.depth)
    np.testing.assert_array_equal(truth.labels, expected.labels)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_perturbation("rain"), "unknown perturbation 'rain'; valid choices: rolling"),
        (lambda: make_perturbation("motion-blur", {"time": 1}), "unknown option of MotionBlur"),
        (lambda: RollingShutter(-0.1), r"RollingShutter.readout_s = -0.1 is outside \[0, 10\]"),
        (lambda: MotionBlur(samples=1), "MotionBlur.samples"),
        (lambda: DepthDropout(patches=1.0), "DepthDropout.patches"),
        (lambda: FrameSkipping(0), "FrameSkipping.keep_every"),
        (lambda: ExposureRamp(gain=float("nan")), "ExposureRamp.gain"),
        (lambda: make_perturbation("moving-objects", {"kind": "dog"}), "box, person, car"),
        (lambda: make_perturbation("moving-objects", {"count": -1}), "count"),
        (lambda: make_perturbation("moving-objects", {"speed_m_s": 0.0}), "speed_m_s"),
        (lambda: make_perturbation("fast-motion", {"factor": 0.5}), "factor"),
        (lambda: make_perturbation("fast-motion", {"share": 1.5}), "share"),
        (lambda: make_perturbation("illumination", {"dim": 1.0}), "dim"),
        (lambda: make_perturbation("illumination", {"lamp": -1.0}), "lamp"),
    ],
)
def test_bad_strengths_are_refused(make, message) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_no_perturbation_and_a_bad_seed_are_refused(box_scene: BoxScene, path) -> None:
    with pytest.raises(InputError, match="'blur' is not a perturbation"):
        render_sequence(box_scene, path, K, perturbations=["blur"])
    with pytest.raises(InputError, match="seed"):
        render_sequence(box_scene, path, K, seed=-1)
    turned = make_pose(so3_exp([0, 0, 0.1]), [0, 0, np.inf])
    with pytest.raises(InputError, match="pose 0 of the trajectory"):
        render_sequence(box_scene, turned[None], K)
