"""Equation (5) against scipy, and its properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import entropy

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.divergence import intensity_divergence
from ms_slam_env.errors import InputError

images = arrays(np.uint8, (6, 8))


def image(seed, low=0, high=256):
    return np.random.default_rng(seed).integers(low, high, (24, 32), dtype=np.uint8)


@pytest.mark.parametrize("bins", [2, 16, 100, 256])
def test_equals_scipy_entropy(bins):
    current, previous = image(1, 0, 200), image(2, 50, 256)
    p, q = (
        np.bincount(grey.ravel().astype(int) * bins // 256, minlength=bins) + 0.5
        for grey in (current, previous)
    )
    assert intensity_divergence(current, previous, bins=bins) == pytest.approx(
        entropy(p, q), rel=1e-12
    )


@given(images, images)
def test_is_non_negative_and_finite(current, previous):
    divergence = intensity_divergence(current, previous)
    assert 0 <= divergence < np.inf


@given(images, images)
def test_is_zero_only_for_equal_histograms(current, previous):
    same = np.array_equal(
        np.bincount(current.ravel(), minlength=256), np.bincount(previous.ravel(), minlength=256)
    )
    assert (intensity_divergence(current, previous) < 1e-12) == same


@given(images, images, st.randoms(use_true_random=False))
def test_order_of_pixels_does_not_matter(current, previous, random):
    pixels = list(current.ravel())
    random.shuffle(pixels)
    shuffled = np.array(pixels, dtype=np.uint8).reshape(current.shape)
    assert intensity_divergence(shuffled, previous) == intensity_divergence(current, previous)


@settings(max_examples=20)
@given(images, st.floats(0.5, 20))
def test_parzen_window_keeps_mass_and_lowers_the_divergence(current, smoothing):
    previous = 255 - current
    plain = intensity_divergence(current, previous, pseudo_count=1e-3)
    smooth = intensity_divergence(current, previous, pseudo_count=1e-3, smoothing=smoothing)
    # Data processing inequality: the window is the same channel for both; only the rows at the
    # two ends of the range, which are renormalised, keep this from holding for the pseudo-count.
    assert smooth <= plain + 1e-2


def test_colour_is_read_by_luma():
    color = np.zeros((4, 4, 3), dtype=np.uint8)
    color[..., 1] = 100
    grey = np.full((4, 4), 59, dtype=np.uint8)  # 0.587 * 100, rounded
    assert intensity_divergence(color, grey) == 0


def test_frames_are_accepted():
    color = np.repeat(image(3)[..., None], 3, axis=2)
    frame = RGBDFrame(color, np.ones(color.shape[:2], dtype=np.float32))
    assert intensity_divergence(frame, image(4)) == intensity_divergence(color, image(4))


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((4, 4), dtype=np.float32),
        np.zeros((4, 4, 4), dtype=np.uint8),
        np.zeros(4, dtype=np.uint8),
        np.zeros((0, 4), dtype=np.uint8),
    ],
)
def test_bad_images_are_refused(bad):
    with pytest.raises(InputError):
        intensity_divergence(bad, image(0))


@pytest.mark.parametrize(
    "options", [{"bins": 1}, {"bins": 257}, {"pseudo_count": 0.0}, {"smoothing": -1.0}]
)
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        intensity_divergence(image(0), image(1), **options)
