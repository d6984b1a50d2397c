"""Exposure, scale and trust of grey values; sequences that change or lack them."""

from __future__ import annotations

import numpy as np
import pytest
from arc import CAMERA, START
from box_scene import BoxScene
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.surfel.normal_equations import NUM_SUMS, RUNNING, Hypotheses, Photometry, Sum
from ms_slam_env.slam.surfel.photometry import (
    ExposureCorrection,
    InvalidFrameDetector,
    correction,
    geometry_only,
    is_invalid_frame,
    next_photometry,
    same_exposure,
)
from ms_slam_env.slam.surfel.preprocessing import Preprocessor
from ms_slam_env.slam.surfel.solver import gauss_newton_step
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig


def _regress(model, live, weight, light, textured_robust=None):
    """One update of the photometry from points' grey values."""
    residual = live - np.clip(light["gain"] * model + light["bias"], 0, 255)
    centred = model - 128.0
    sums = np.zeros(NUM_SUMS)
    sums[Sum.EXPOSURE_W : Sum.EXPOSURE_WMR + 1] = [
        (weight * term).sum()
        for term in (np.ones_like(model), centred, centred**2, residual, centred * residual)
    ]
    sums[Sum.EXPOSURE_WRR] = (weight * residual**2).sum()
    if textured_robust is not None:
        sums[Sum.TEXTURED] = len(textured_robust)
        sums[Sum.ROUGH] = (1 - textured_robust).sum()
    one = Hypotheses()
    one.pose = wp.array(np.eye(4)[None, None], dtype=wp.mat44d)
    one.state = wp.array([[RUNNING]], dtype=wp.int32)
    one.photometry = wp.array(light[:, None], dtype=Photometry)
    one.sums = wp.array(sums[None, None], dtype=wp.float64)
    wp.launch(gauss_newton_step, dim=(1, 1), inputs=[one, 1e-6, 1e-3, 0, 1.0])
    return one.photometry.numpy()[:, 0]


@given(seed=st.integers(0, 1000), gain=st.floats(0.5, 1.6), bias=st.floats(-20, 20))
@settings(max_examples=30, deadline=None)
def test_gain_and_bias_are_recovered(seed, gain, bias):
    rng = np.random.default_rng(seed)
    model = rng.uniform(60, 120, 2000)
    live = gain * model + bias
    light = same_exposure(1)
    for _ in range(4):
        light = _regress(model, live, rng.uniform(0.5, 1, 2000), light)
    assert light["gain"][0] == pytest.approx(gain, rel=0.05)
    middle = light["gain"][0] * 90 + light["bias"][0]
    assert middle == pytest.approx(gain * 90 + bias, abs=0.5)


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_noise_of_the_model_does_not_shrink_the_gain(gain):
    rng = np.random.default_rng(0)
    true = rng.normal(110, 20, 5000)
    light = same_exposure(1)
    light["gain"] = gain
    for _ in range(20):  # frames whose model is blurred or misaligned, each in another way
        model, live = true + rng.normal(0, 10, 5000), gain * true + rng.normal(0, 2, 5000)
        light = _regress(model, live, np.ones(5000), light)
        light["bias"] = 0.0
    # Regression would have 0.8 of it after the first frame.
    assert light["gain"][0] == pytest.approx(gain, rel=0.01)


def test_without_contrast_only_the_bias_moves():
    model = np.full(500, 90.0)
    light = _regress(model, model + 12.0, np.ones(500), same_exposure(1))
    assert light["gain"][0] == 1.0
    assert light["bias"][0] == pytest.approx(12.0, abs=1e-4)


@pytest.mark.parametrize("scale", [2.0, 9.0])
def test_the_scale_is_that_of_cauchys_distribution(scale):
    residuals = scale * np.random.default_rng(0).standard_cauchy(20_000)
    light, flat = same_exposure(1), np.full(10, 100.0)
    for _ in range(12):
        robust = 1 / (1 + (residuals / max(light["scale"][0], 1.0)) ** 2)
        light = _regress(flat, flat, np.ones(10), light, robust)
    assert light["scale"][0] == pytest.approx(scale, rel=0.05)


def test_conflict_lowers_trust_and_agreement_restores_it():
    light = same_exposure(1)
    for _ in range(5):
        light = next_photometry(light, light, np.array([5.0]), 1.0)
    assert light["trust"][0] == pytest.approx(0.2**5, rel=0.05)
    blind = geometry_only(light)
    assert next_photometry(light, blind, np.zeros(1), 1.0)["trust"] == light["trust"]
    for _ in range(100):
        light = next_photometry(light, light, np.array([0.1]), 1.0)
    assert light["trust"][0] == 1.0


def test_colours_come_back_to_the_maps_exposure():
    small = Intrinsics(fx=20.0, fy=20.0, cx=15.5, cy=11.5, width=32, height=24)
    rng = np.random.default_rng(0)
    map_color = rng.integers(40, 160, (2, *small.shape, 3)).astype(np.uint8)
    live_color = np.stack([map_color[0], np.round(1.5 * map_color[1] + 10).astype(np.uint8)])
    live = Preprocessor(2, small, SurfelConfig())(
        live_color, np.ones((2, *small.shape), np.float32)
    )
    lights = same_exposure(2)
    lights["gain"][1], lights["bias"][1] = 1.5, 10.0
    gain, bias = correction(lights)
    assert (gain[0], bias[0]) == (1.0, 0.0)
    assert gain[1] == pytest.approx(1.5, rel=0.05)
    ExposureCorrection(2, small, "cpu")(live, lights)
    corrected = live.color.numpy()
    np.testing.assert_array_equal(corrected[0], map_color[0])
    # Within what is left alone: 4 % and 4 grey levels about the middle.
    assert np.abs(corrected[1] - map_color[1]).max() < 8


def _frames(count: int = 14) -> tuple[np.ndarray, list[RGBDFrame]]:
    """A slow arc through the box, 2 cm and 1 degree a frame."""
    poses = [START]
    for _ in range(count - 1):
        poses.append(poses[-1] @ make_pose(so3_exp([0, np.radians(-1), 0]), [0.02, 0, 0.004]))
    sensor = RGBDSensor(BoxScene(), CAMERA, noise="kinect", seed=0)
    return np.stack(poses), [sensor.capture(pose, index) for index, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def sequence() -> tuple[np.ndarray, list[RGBDFrame]]:
    return _frames()


def _run(frames, poses) -> tuple[float, slam.SlamBackend]:
    backend = slam.make("surfel", CAMERA, max_surfels=60_000, depth_cutoff_m=4.0)
    backend.reset(poses[0])
    worst = 0.0
    for frame, truth in zip(frames, poses, strict=True):
        result = backend.track(frame)
        assert result.tracking_ok, result.reason
        worst = max(worst, float(np.linalg.norm(result.T_world_camera[:3, 3] - truth[:3, 3])))
    return worst, backend


def test_jumps_of_the_exposure_neither_break_tracking_nor_stripe_the_map(sequence):
    poses, frames = sequence
    changed = []
    for index, frame in enumerate(frames):
        gain = (1.0, 0.6, 0.9)[index // 5]
        color = np.clip(gain * frame.color + 5.0 * (index // 5), 0, 255).astype(np.uint8)
        changed.append(RGBDFrame(color, frame.depth, frame.timestamp))
    worst, backend = _run(changed, poses)
    assert worst < 0.012
    _, plain = _run(frames, poses)
    # The map keeps the brightness of the first frames although most later ones are darker.
    bright, expected = (b.surface_colors().mean() for b in (backend, plain))
    assert abs(bright - expected) < 0.1 * expected


@pytest.mark.parametrize("grey", [0, 128])
def test_depth_alone_is_tracked(sequence, grey):
    poses, frames = sequence
    blank = np.full((*CAMERA.shape, 3), grey, dtype=np.uint8)
    worst, _ = _run([RGBDFrame(blank, f.depth, f.timestamp) for f in frames], poses)
    assert worst < 0.03


def test_colour_that_is_not_registered_with_depth_is_trusted_less(sequence):
    poses, frames = sequence
    columns = np.clip(np.round((np.arange(160) - 79.5) * 585 / 525 + 79.5), 0, 159).astype(int)
    rows = np.clip(np.round((np.arange(120) - 59.5) * 585 / 525 + 59.5), 0, 119).astype(int)
    shrunk = [RGBDFrame(f.color[rows][:, columns], f.depth, f.timestamp) for f in frames]
    worst, backend = _run(shrunk, poses)
    assert worst < 0.04
    assert backend.get_state()["photometry"]["trust"][0] < 0.5
    _, registered = _run(frames, poses)
    assert registered.get_state()["photometry"]["trust"][0] > 0.5


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
    started, depth = np.zeros(2, dtype=bool), np.ones((2, *black.shape[:2]), dtype=np.float32)

    def blank(*colors: np.ndarray) -> list[bool]:
        return frames.find(Images(np.stack(colors), depth), started).tolist()

    assert blank(black, image) == [False, False]
    started[:] = True
    assert blank(black, black) == [False, True]
    assert blank(image, image) == [False, False]


@pytest.mark.parametrize("depth_too", [True, False])
def test_a_black_frame_is_lost_at_once_and_tracking_resumes(arc_frames, depth_too):
    frames = arc_frames[:9]
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


def test_a_recording_without_colour_is_tracked(arc_frames):
    backend = slam.make("surfel", CAMERA, max_surfels=60_000, depth_cutoff_m=4.0)
    backend.reset(START)
    for frame in arc_frames[:5]:
        result = backend.track(RGBDFrame(np.zeros_like(frame.color), frame.depth))
        assert result.tracking_ok, result.reason
