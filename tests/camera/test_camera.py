"""Projection, scaling and frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame, intensity_image, xtion
from ms_slam_env.errors import InputError


@pytest.mark.parametrize("size", XTION_SIZES)
def test_rays_and_projection_are_inverse(size):
    camera = xtion(size)
    rays = camera.rays()
    assert rays.shape == (camera.height, camera.width, 3)
    v, u = np.mgrid[: camera.height, : camera.width]
    np.testing.assert_allclose(camera.project(rays * 2.5), np.stack([u, v], -1), atol=1e-9)


@given(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3))
def test_scaling_keeps_what_is_seen(x, y):
    camera = xtion("160x120")
    half = camera.scaled(0.5)
    u, v = camera.project([x, y, 1.0])
    # The image spans [-0.5, width - 0.5]: relative position in it must not change.
    expected = ((u + 0.5) / 160 * 80 - 0.5, (v + 0.5) / 120 * 60 - 0.5)
    np.testing.assert_allclose(half.project([x, y, 1.0]), expected, atol=1e-9)
    assert half.shape == (60, 80)


def test_scaling_to_a_size_that_rounds_keeps_the_pixels_of_the_scaled_camera():
    camera = xtion("160x120").scaled(0.33)
    assert (camera.width, camera.height) == (53, 40)


def test_field_of_view_of_the_xtion():
    for size in XTION_SIZES:
        camera = xtion(size)
        fov = 2 * np.degrees(
            np.arctan([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
        )
        np.testing.assert_allclose(fov, [58, 45], atol=1)
        assert (camera.cx, camera.cy) == ((camera.width - 1) / 2, (camera.height - 1) / 2)


@pytest.mark.parametrize(
    "change", [{"fx": 0.0}, {"fy": -1.0}, {"cx": np.nan}, {"width": 0}, {"fx": np.inf}]
)
def test_bad_intrinsics_are_refused(change):
    values = {"fx": 100.0, "fy": 100.0, "cx": 50.0, "cy": 40.0, "width": 100, "height": 80}
    with pytest.raises(InputError):
        Intrinsics(**{**values, **change})


def test_unknown_size_lists_the_valid_ones():
    with pytest.raises(InputError, match="160x120"):
        xtion("7x100")


def test_images_of_another_size_are_refused():
    camera = xtion("80x60")
    camera.check_image(np.zeros((60, 80, 3)), "color")
    with pytest.raises(InputError, match="60x80 but the intrinsics say 80x60"):
        camera.check_image(np.zeros((80, 60)), "color")
    with pytest.raises(InputError, match="image"):
        camera.check_image(np.zeros(60), "color")


def test_grey_is_luma():
    image = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]], dtype=np.uint8)
    assert intensity_image(image).tolist() == [[76, 150, 29, 255]]
    grey = intensity_image(image)
    assert intensity_image(grey) is grey


@pytest.mark.parametrize(
    "bad", [np.zeros((2, 2)), np.zeros((2, 2, 4), np.uint8), np.zeros(3, np.uint8)]
)
def test_bad_images_are_refused(bad):
    with pytest.raises(InputError):
        intensity_image(bad)


COLOR = np.zeros((3, 4, 3), dtype=np.uint8)
DEPTH = np.ones((3, 4), dtype=np.float32)


def test_a_frame_takes_zero_as_no_reading():
    assert RGBDFrame(COLOR, DEPTH * 0).timestamp == 0.0


@pytest.mark.parametrize(
    ("color", "depth", "match"),
    [
        (COLOR.astype(float), DEPTH, "uint8"),
        (COLOR[..., :1], DEPTH, "color"),
        (COLOR, DEPTH[:2], "shape"),
        (COLOR, DEPTH * np.nan, "NaN"),
        (COLOR, DEPTH * np.inf, "infinite"),
        (COLOR, -DEPTH, "negative"),
        (COLOR, DEPTH.astype(np.uint16), "float"),
    ],
)
def test_bad_frames_are_refused(color, depth, match):
    with pytest.raises(InputError, match=match):
        RGBDFrame(color, depth)


@given(st.integers(1, 7))
def test_every_nth_pixel_has_the_ray_it_had(n: int) -> None:
    whole = Intrinsics(fx=281.0, fy=280.0, cx=80.3, cy=59.1, width=161, height=118)
    rays = whole.rays()[::n, ::n]
    kept = whole.every_nth(n)
    assert kept.shape == rays.shape[:2]
    np.testing.assert_allclose(kept.rays(), rays, rtol=1e-12, atol=1e-12)


def test_every_nth_needs_a_positive_number() -> None:
    with pytest.raises(InputError, match="n = 0 must be >= 1"):
        xtion().every_nth(0)
