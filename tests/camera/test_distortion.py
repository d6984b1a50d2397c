"""Lenses: both models and the straightening of images against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env import slam
from ms_slam_env.camera import Distortion, Intrinsics
from ms_slam_env.camera.undistortion import undistort_color, undistort_depth
from ms_slam_env.errors import InputError

# fr1 of the TUM RGB-D benchmark; cam0 of TUM-VI.
KINECT = Distortion("radial-tangential", 0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
FISHEYE = Distortion.of("equidistant", [0.00348, 0.000715, -0.00205, 0.000202])
CAMERA = Intrinsics(517.3, 516.5, 318.6, 255.3, 640, 480, KINECT)
WIDE = Intrinsics(190.9, 190.9, 254.9, 256.8, 512, 512, FISHEYE)
# The colour camera of an Azure Kinect.
AZURE = Distortion.of(
    "rational_polynomial", [0.517, -2.627, 0.00054, -0.00021, 1.522, 0.394, -2.449, 1.448]
)
RATIONAL = Intrinsics(605.9, 605.7, 638.2, 363.5, 1280, 720, AZURE)
LENSES = {"radial-tangential": CAMERA, "equidistant": WIDE, "rational": RATIONAL}


def opencv_projection(K, points):
    d = K.distortion
    args = (points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K.matrix)
    if d.model == "equidistant":
        numbers = np.array([d.k1, d.k2, d.k3, d.k4])
        return cv2.fisheye.projectPoints(*args, numbers)[0].reshape(-1, 2)
    numbers = np.array([d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6])
    return cv2.projectPoints(*args, numbers)[0].reshape(-1, 2)


@pytest.mark.parametrize("model", LENSES)
def test_projection_is_that_of_opencv(model):
    K = LENSES[model]
    points = 2.5 * K.undistorted.rays()[::37, ::41].reshape(-1, 3)
    np.testing.assert_allclose(K.project(points), opencv_projection(K, points), atol=1e-6)


@given(st.floats(0, 639), st.floats(0, 479))
def test_rays_are_the_inverse_of_projection(u, v):
    for K in (CAMERA, CAMERA.scaled(0.5), CAMERA.cropped(10, 20, 600, 400).resized(300, 200)):
        pixel = np.array([u, v]) * (K.width - 1, K.height - 1) / (639, 479)
        np.testing.assert_allclose(K.project(K.rays_at(pixel) * 1.7), pixel, atol=1e-5)


def test_rays_of_a_rational_lens_are_the_inverse_of_projection():
    pixels = np.stack(np.meshgrid(np.arange(0, 1280, 97), np.arange(0, 720, 83)), axis=-1)
    np.testing.assert_allclose(RATIONAL.project(RATIONAL.rays_at(pixels)), pixels, atol=1e-6)
    plain = Distortion.of("rational_polynomial", [0.1, -0.2, 0, 0, 0.05, 0, 0, 0])
    assert plain == Distortion.of("plumb_bob", [0.1, -0.2, 0, 0, 0.05])


def test_rays_of_a_fisheye_are_the_inverse_of_projection():
    pixels = np.stack(np.meshgrid(np.arange(60, 450, 30.0), np.arange(60, 450, 30.0)), axis=-1)
    np.testing.assert_allclose(WIDE.project(WIDE.rays_at(pixels)), pixels, atol=1e-5)
    with pytest.raises(InputError, match="leads no ray"):
        WIDE.rays_at([-300.0, -300.0])  # more than 90 degrees from the axis


def test_straight_images_are_those_of_opencv():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3)).astype(np.uint8), (9, 9), 3)
    numbers = [getattr(KINECT, name) for name in ("k1", "k2", "p1", "p2", "k3")]
    how = CAMERA.matrix, np.array(numbers)
    truth = cv2.undistort(image, *how)
    difference = np.abs(undistort_color(image, CAMERA).astype(int) - truth)
    assert difference.max() <= 4  # maps there are of 1/32 px
    assert difference.mean() < 0.2
    maps = cv2.initUndistortRectifyMap(*how, None, CAMERA.matrix, (640, 480), cv2.CV_32FC1)
    places = CAMERA.project(CAMERA.undistorted.rays())
    np.testing.assert_allclose(places, np.stack(maps, axis=-1), atol=1e-3)
    depth = rng.integers(0, 5000, (480, 640)).astype(np.uint16)
    straight = undistort_depth(depth, CAMERA)
    column, row = np.rint(CAMERA.project(CAMERA.undistorted.rays())).astype(int)[240, 100]
    assert straight[240, 100] == depth[row, column]
    assert straight.dtype == np.uint16


def test_a_lens_survives_a_change_of_size_and_not_straightening():
    assert CAMERA.scaled(0.5).distortion == CAMERA.every_nth(2).distortion == KINECT
    assert not CAMERA.undistorted.distortion
    assert CAMERA.undistorted == Intrinsics(517.3, 516.5, 318.6, 255.3, 640, 480)


@pytest.mark.parametrize(
    ("model", "numbers", "complaint"),
    [
        ("radial-tangential", [-0.9], "folds an image of 640x480"),
        ("radial-tangential", [30.0], r"k1 = 30.0 is outside \[-20, 20\]"),
        ("tilted", [1.0], "unknown distortion model 'tilted'; valid choices: radial-tang"),
        ("rational", [0, 0, 0, 0, 0, -2.0], "folds an image of 640x480"),
        ("rational", [0, 0, 0, 0, 0, 2e3], r"k4 = 2000.0 is outside \[-1000, 1000\]"),
        ("rational", [0.1] * 12, "has 8 numbers"),
        ("radtan", [0.1] * 6, "has 5 numbers"),
        ("equidistant", [float("nan")], "k1 = nan is outside"),
    ],
)
def test_bad_lenses_are_refused(model, numbers, complaint):
    with pytest.raises(InputError, match=complaint):
        Intrinsics(517.3, 516.5, 318.6, 255.3, 640, 480, Distortion.of(model, numbers))
    with pytest.raises(InputError, match="equidistant has no p1; it has"):
        Distortion("equidistant", p1=0.1)


def test_slam_refuses_a_lens():
    for name in ("surfel", "odometry"):
        with pytest.raises(InputError, match="needs images without distortion"):
            slam.make(name, CAMERA.scaled(0.25))
