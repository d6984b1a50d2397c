"""Colour brought into the depth camera, and images made smaller, against truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from box_scene import BoxScene
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ms_slam_env.camera import Intrinsics, intensity_image, xtion
from ms_slam_env.camera.frame import reduce_color, reduce_depth
from ms_slam_env.errors import InputError
from ms_slam_env.sensor import NoNoise
from ms_slam_env.sequences import Misregistration, handheld_trajectory, render_sequence
from ms_slam_env.sequences.recording import Registration, open_recording

K = xtion("320x240")


@pytest.fixture(scope="module")
def pose(box_scene: BoxScene) -> np.ndarray:
    return handheld_trajectory(box_scene, 2, 3)[:1]


def error(color: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float:
    """Median difference of the intensities, in steps of 255."""
    difference = np.abs(intensity_image(color).astype(float) - intensity_image(truth))
    return float(np.median(difference if where is None else difference[where]))


@pytest.mark.parametrize(
    "camera", [(525 / 585, 0.025, 0, 0), (1.0, 0.025, 0, 0), (0.9, 0, 0, 0), (0.93, -0.04, 3, -2)]
)
def test_registered_colour_is_that_of_the_depth_camera(box_scene, pose, camera) -> None:
    off = Misregistration(*camera)
    frame = render_sequence(box_scene, pose, K, "none", perturbations=[off]).frames[0]
    truth = render_sequence(box_scene, pose, K, "none").frames[0]
    registered = Registration(*camera).register(frame.color, frame.depth, K)
    assert error(frame.color, truth.color) > 4
    assert error(registered, truth.color) <= 1
    # Holes borrow the depth beside them: no worse than a little.
    holed = frame.depth.copy()
    rng = np.random.default_rng(0)
    for _ in range(30):
        v, u = rng.integers(0, 230), rng.integers(0, 310)
        holed[v : v + 10, u : u + 10] = 0
    borrowed = Registration(*camera).register(frame.color, holed, K)
    assert error(borrowed, truth.color, holed == 0) <= 2


def test_registration_of_nothing_is_the_identity() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 3, (240, 320)).astype(np.float32)
    same = Registration(1.0, 0.0).register(color, depth, K)
    np.testing.assert_array_equal(same, color)
    np.testing.assert_array_equal(Registration(1.0, 0.0).register(color, 0 * depth, K), color)


def test_without_any_depth_the_offset_is_neglected() -> None:
    color = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    depth = np.zeros((240, 320), np.float32)
    far = np.full((240, 320), 1e30, np.float32)
    registration = Registration()
    np.testing.assert_array_equal(
        registration.register(color, depth, K), registration.register(color, far, K)
    )


def test_a_hole_borrows_the_nearest_reading() -> None:
    """Against a slow search."""
    depth = np.zeros((12, 16), np.float32)
    depth[2, 3], depth[9, 12] = 1.0, 2.0
    camera = Intrinsics(40, 40, 7.5, 5.5, 16, 12)
    color = np.tile(np.arange(16, dtype=np.uint8)[None, :, None] * 10, (12, 1, 3))
    result = Registration(1.0, 0.05).register(color, depth, camera)
    for v in range(12):
        for u in range(16):
            first, second = np.hypot(v - 2, u - 3), np.hypot(v - 9, u - 12)
            if abs(first - second) < 0.5:
                continue  # the distance transform is an approximation
            z = 1.0 if first < second else 2.0
            expected = 10 * np.clip(u - 40 * 0.05 / z, 0, 15)
            assert abs(float(result[v, u, 0]) - expected) <= 1


def seven_scenes(folder: Path, sequence) -> Path:
    folder.mkdir()
    for index, (frame, T) in enumerate(sequence):
        values = np.rint(frame.depth * 1000).astype(np.uint16)
        values[frame.depth == 0] = 65535
        stem = folder / f"frame-{index:06d}"
        Image.fromarray(values).save(f"{stem}.depth.png")
        Image.fromarray(frame.color).save(f"{stem}.color.png")
        np.savetxt(f"{stem}.pose.txt", T, fmt="%.5e")
    i = sequence.intrinsics
    line = f"{i.fx} {i.fy} {i.cx} {i.cy} {i.width} {i.height}"
    (folder / "intrinsics.txt").write_text(line)
    return folder


@pytest.mark.parametrize("size", ["native", "160x120"])
def test_seven_scenes_are_registered_unless_told_otherwise(box_scene, pose, tmp_path, size) -> None:
    ideal = dataclasses.replace(NoNoise(), max_range_m=2.2)  # so that some pixels have no reading
    off = [Misregistration()]
    sequence = render_sequence(box_scene, pose, K, ideal, perturbations=off)
    folder = seven_scenes(tmp_path / "seq-01", sequence)
    recording = open_recording(folder).at_size(size)
    assert recording.registration == Registration()
    assert "baseline 2.5 cm" in str(recording.registration)
    frame = recording.frame(0)
    assert 0.01 < (frame.depth == 0).mean() < 0.9
    assert frame.depth.max() < 2.3  # 65535 is no reading
    truth = render_sequence(box_scene, pose, K, "none").frames[0].color
    truth = reduce_color(truth, (recording.intrinsics.width, recording.intrinsics.height))
    read = frame.depth > 0
    assert error(frame.color, truth, read) <= 1
    raw = open_recording(folder, register=False).at_size(size)
    assert raw.registration is None
    assert error(raw.frame(0).color, truth, read) > 3
    if size == "native":
        np.testing.assert_array_equal(raw.frame(0).color, sequence.frames[0].color)
    other = open_recording(folder, register=Registration(1.0, 0.0)).at_size(size)
    np.testing.assert_array_equal(other.frame(0).color, raw.frame(0).color)


def test_bad_numbers_are_refused() -> None:
    with pytest.raises(InputError, match=r"Registration\.focal_ratio"):
        Registration(focal_ratio=0.0)
    with pytest.raises(InputError, match=r"Registration\.baseline_m"):
        Registration(baseline_m=float("nan"))


# ---------------------------------------------------------------- smaller images


@given(st.integers(0, 1000), st.sampled_from([2, 4]))
def test_reduced_depth_is_the_mean_of_one_surface(seed: int, factor: int) -> None:
    """Against a slow loop."""
    rng = np.random.default_rng(seed)
    depth = rng.choice([0.0, 1.0, 1.01, 1.02, 2.0], (8, 12)).astype(np.float32)
    reduced = reduce_depth(depth, (12 // factor, 8 // factor))
    for v in range(8 // factor):
        for u in range(12 // factor):
            block = depth[v * factor : (v + 1) * factor, u * factor : (u + 1) * factor]
            centre = block[factor // 2, factor // 2]
            like = block[(block > 0) & (np.abs(block - centre) <= np.float32(0.03) * centre)]
            expected = like.mean() if centre > 0 else 0.0
            assert reduced[v, u] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("size", ["320x240", "160x120", "80x60"])
def test_reduced_depth_fits_the_reduced_intrinsics(box_scene: BoxScene, pose, size: str) -> None:
    """A picked reading lies half a pixel beside the centre; the mean does not."""
    large = xtion("640x480")
    small = xtion(size)
    width, height = small.width, small.height
    depth = render_sequence(box_scene, pose, large, "none").frames[0].depth
    truth = render_sequence(box_scene, pose, small, "none").frames[0].depth
    reduced = reduce_depth(depth, (width, height))
    picked = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
    inside = np.abs(reduced - truth) < 0.05 * truth
    assert inside.mean() > 0.97
    assert np.abs(reduced - truth)[inside].mean() < 0.3 * np.abs(picked - truth)[inside].mean()


def test_reduction_takes_off_noise(box_scene: BoxScene, pose) -> None:
    depth = render_sequence(box_scene, pose, xtion("640x480"), "kinect").frames[0].depth
    truth = render_sequence(box_scene, pose, xtion("160x120"), "none").frames[0].depth
    reduced = reduce_depth(depth, (160, 120))
    picked = cv2.resize(depth, (160, 120), interpolation=cv2.INTER_NEAREST_EXACT)
    read = picked > 0
    np.testing.assert_array_equal(reduced > 0, read)
    wrong = np.median(np.abs(reduced - truth)[read]) / np.median(np.abs(picked - truth)[read])
    assert wrong < 0.6


def test_sizes_that_do_not_divide_pick_readings() -> None:
    depth = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
    assert set(reduce_depth(depth, (3, 2)).ravel()) <= set(depth.ravel())
