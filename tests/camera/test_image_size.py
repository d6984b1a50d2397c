"""Sizes by name: which part of an image is taken, and the camera that remains."""

import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ms_slam_env.camera import Intrinsics, parse_image_size, rendered_size, xtion
from ms_slam_env.errors import InputError

SIDES = st.integers(8, 4096)


def _camera(width: int, height: int) -> Intrinsics:
    return Intrinsics(0.9 * width, 0.8 * width, 0.45 * width, 0.52 * height, width, height)


def test_the_largest_central_part_of_the_aspect():
    crop = parse_image_size("160x120+crop").part_of(_camera(540, 360), "x")
    assert (crop.left, crop.top, crop.width, crop.height) == (30, 0, 480, 360)


def test_a_part_that_is_named():
    crop = parse_image_size("160x120+crop=320x240").part_of(_camera(541, 361), "x")
    assert (crop.left, crop.top, crop.width, crop.height) == (110, 60, 320, 240)
    crop = parse_image_size("native+crop=100x50").part_of(_camera(101, 51), "x")
    assert (crop.left, crop.top, crop.width, crop.height) == (0, 0, 100, 50)


@given(SIDES, SIDES, SIDES, SIDES)
def test_a_crop_fits_where_the_size_is_not_larger(width, height, new_width, new_height):
    source = _camera(width, height)
    named = parse_image_size(f"{new_width}x{new_height}+crop")
    if new_width > width or new_height > height:
        with pytest.raises(InputError, match="cannot be reduced"):
            named.part_of(source, "x")
        return
    crop = named.part_of(source, "x")
    part = source.cropped(crop.left, crop.top, crop.width, crop.height)
    assert crop.width == width or crop.height == height
    assert abs(crop.left - (width - crop.left - crop.width)) <= 1
    assert abs(crop.top - (height - crop.top - crop.height)) <= 1
    # Stretched by less than half a pixel of the part.
    assert abs(crop.width * new_height - crop.height * new_width) <= max(new_width, new_height)
    camera = part.resized(new_width, new_height)
    # What the corners of the image show is what the corners of the part show.
    corners = np.array([[-0.5, -0.5], [new_width - 0.5, new_height - 0.5]])
    there = np.array([[-0.5, -0.5], [crop.width - 0.5, crop.height - 0.5]])
    np.testing.assert_allclose(
        camera.rays_at(corners), source.rays_at(np.add(there, [crop.left, crop.top])), atol=1e-9
    )


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ("160x120", "valid choices: native, 160x120+crop, which takes their central 480x360"),
        ("640x480", "540x360 cannot be reduced to 640x480; valid choices: native"),
        ("160x120+crop=541x360", "540x360 have no part of 541x360"),
        ("160x120+crop=300x300", "300x300 cannot be reduced to 160x120"),
    ],
)
def test_what_does_not_fit_names_what_does(size, message):
    with pytest.raises(InputError, match=re.escape(message)):
        parse_image_size(size).part_of(_camera(540, 360), "x")


@pytest.mark.parametrize(
    "text", ["", "1x1", "7x100", "100x4097", "160", "160x120+", "160x120+crop=", "99999999x9", "x"]
)
def test_no_size(text):
    with pytest.raises(InputError, match=r"unknown image size .*160x120\+crop.*native"):
        parse_image_size(text)


def test_rendered_images_are_not_cut():
    assert rendered_size("160x120+crop") == (160, 120)
    for text in ("native", "160x120+crop=480x360"):
        with pytest.raises(InputError, match="rendered images"):
            rendered_size(text)


@given(st.integers(8, 1000), st.integers(8, 1000))
def test_any_size_of_the_xtion_is_a_part_of_its_view(width, height):
    assume(width * height > 100)
    camera, whole = xtion(f"{width}x{height}"), xtion("640x480")
    assert (camera.width, camera.height) == (width, height)
    corner = np.abs(camera.rays_at([-0.5, -0.5])[:2])
    limit = np.abs(whole.rays_at([-0.5, -0.5])[:2])
    assert (corner <= limit + 1e-9).all()
    assert np.isclose(corner, limit).any()


@pytest.mark.parametrize("change", [{"width": 5000}, {"fx": 1e9}, {"cy": -1e9}, {"fy": 1e-9}])
def test_no_camera_is_that_large(change):
    values = {"fx": 100.0, "fy": 100.0, "cx": 50.0, "cy": 40.0, "width": 100, "height": 80}
    with pytest.raises(InputError, match="at most"):
        Intrinsics(**{**values, **change})
