"""Relation of a live image's grey values to the map's: exposure, scale of residuals, trust.

Tracking estimates them, see ``normal_equations`` and ``solver``; this module carries them from
frame to frame. It also detects invalid frames: black or blank ones, from a shutter, a dropped frame
or glare, which hold nothing to track.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.images import Images, Surveyor
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.surfel.device import (
    KernelLaunchCache,
    SavedBuffer,
    fetch,
    put,
    threads_per_row,
)
from ms_slam_env.slam.surfel.normal_equations import Photometry
from ms_slam_env.slam.surfel.preprocessing import BAD_DEPTH, LiveFrame

DTYPE: np.dtype[Any] = Photometry.numpy_dtype()  # type: ignore[attr-defined]
# A gain this close to 1 and a bias this close to 0 are not corrected: their systematic error,
# applied frame after frame, would bleach or darken the map.
SMALL_GAIN = 0.04
SMALL_BIAS = 4.0
MIDDLE_GREY = 128.0  # about which gain and bias are nearly independent
LARGEST_CONFLICT = 1.0  # 95 % of the frames of registered images have less
TRUST_FALLS = 0.2  # smallest factor per frame
TRUST_GROWS = 1.15  # factor per frame
LEAST_TRUST = 1.0e-4
USUAL_SCALE = 1.4  # a frame's residuals may have 1.4 times the scale estimated for the last ones
SCALE_FALLS = 0.1  # share of the way to a smaller scale, per frame
LEAP = 1.3  # ratio to the scale of the frames before
TRUSTED = 0.1  # trust above which grey values counted
_EVERY = 4  # every n-th row and column is sampled
_CONSTANT = 0.5  # largest standard deviation of an image that no sensor took, grey levels
# An image darker or brighter than these means, with at most this standard deviation, is black or
# glare; grey levels.
_DARK, _BRIGHT = 16.0, 240.0
_FAINT = 4.0


def same_exposure(batch: int) -> NDArray[Any]:
    """Photometry (B,) of images exposed like the map, full trust."""
    photometry = np.zeros(batch, dtype=DTYPE)
    for name in ("gain", "scale", "reference", "trust"):
        photometry[name] = 1.0
    return photometry


def geometry_only(photometry: NDArray[Any]) -> NDArray[Any]:
    """A copy (B,) without trust in grey values, for an alignment by geometry alone."""
    blind = photometry.copy()
    blind["trust"] = 0.0
    return blind


def next_photometry(
    before: NDArray[Any], frame: NDArray[Any], conflict: NDArray[np.float64], least_scale: float
) -> NDArray[Any]:
    """Photometry (B,) after frames were tracked with ``before`` and ended as ``frame``.

    ``conflict`` (B,) is chi squared between the poses that depth and grey values ask for. A
    recording whose colour and depth are not registered has much of it, again and again; its grey
    values are trusted less until the two agree within what is left of the photometric term's
    certainty.
    """
    after = frame.copy()
    share = at_least(1.0, USUAL_SCALE * frame["scale"].astype(np.float64) / least_scale)
    usual = before["reference"].astype(np.float64)
    after["reference"] = np.where(share > usual, share, usual + SCALE_FALLS * (share - usual))
    falls = at_least(TRUST_FALLS, LARGEST_CONFLICT / at_least(LARGEST_CONFLICT, conflict))
    change = np.where(conflict > LARGEST_CONFLICT, falls, TRUST_GROWS)
    # Without trust grey values had no say, and nothing was learnt about them.
    trust = before["trust"].astype(np.float64) * np.where(frame["trust"] > 0.0, change, 1.0)
    after["trust"] = np.minimum(1.0, at_least(LEAST_TRUST, trust))
    return after


def at_least(least: float, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values, but ``least`` where they are less, or no number."""
    return np.where(values > least, values, least)


def is_leap(before: NDArray[Any], frame: NDArray[Any], least_scale: float) -> Bool:
    """Envs (B,) whose grey values, trusted before, suddenly fit worse or not at all."""
    share = USUAL_SCALE * frame["scale"] / least_scale
    is_blind = (frame["trust"] == 0.0) & (before["trust"] > TRUSTED)
    return (share > LEAP * before["reference"]) | is_blind


def correction(photometry: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gain (B,) and bias (B,) to remove from colours; exactly 1 and 0 if they are small."""
    gain = np.exp(_shrink(np.log(photometry["gain"].astype(np.float64)), SMALL_GAIN))
    shift = photometry["bias"] + MIDDLE_GREY * (photometry["gain"].astype(np.float64) - 1.0)
    return gain, _shrink(shift, SMALL_BIAS) - MIDDLE_GREY * (gain - 1.0)


def _shrink(values: NDArray[np.float64], threshold: float) -> NDArray[np.float64]:
    """Soft thresholding: move values towards zero by ``threshold``."""
    return np.sign(values) * np.maximum(np.abs(values) - threshold, 0.0)


@wp.kernel
def _correct(
    per_gain: wp.array[wp.float32],  # (B,)
    bias: wp.array[wp.float32],
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,  # per thread
    color: wp.array[wp.vec3],
) -> None:
    """Replace colour by (colour - bias) / gain, clamped to [0, 255]."""
    row, piece = wp.tid()
    b = row / height
    scale = per_gain[b]
    offset = -bias[b] * scale
    i = row * width + piece * columns
    end = row * width + wp.min((piece + 1) * columns, width)
    while i < end:
        c = fetch(color, i)
        red = wp.clamp(c[0] * scale + offset, 0.0, 255.0)
        green = wp.clamp(c[1] * scale + offset, 0.0, 255.0)
        blue = wp.clamp(c[2] * scale + offset, 0.0, 255.0)
        put(color, i, wp.vec3(red, green, blue))
        i += 1


class ExposureCorrection:
    """Corrects the live colours to the map's exposure, so that fusion leaves no stripes."""

    def __init__(self, batch: int, intrinsics: Intrinsics, device: str) -> None:
        self._size = intrinsics.shape
        self._columns, threads = threads_per_row(intrinsics.width, device)
        self._dim = (batch * intrinsics.height, threads)
        self._per_gain = SavedBuffer(batch, wp.float32, device)
        self._bias = SavedBuffer(batch, wp.float32, device)
        self._launches = KernelLaunchCache(device)

    def __call__(self, live: LiveFrame, photometry: NDArray[Any]) -> None:
        """Change ``live.color`` in place where ``photometry`` (B,) differs from the map."""
        gain, bias = correction(photometry)
        if (gain == 1.0).all() and (bias == 0.0).all():
            return
        self._per_gain.write(1.0 / gain)
        self._bias.write(bias)
        inputs = [self._per_gain.array, self._bias.array, *self._size, self._columns]
        color = live.color
        self._launches.launch("correct", _correct, lambda: (self._dim, [*inputs, color.flatten()]))


def is_invalid_frame(color: NDArray[np.uint8]) -> Bool:
    """Which images (B, H, W, 3) show nothing: one colour throughout, black, or glare.

    An image of a plain wall is valid: it has the sensor's noise and a medium brightness.
    """
    # Image by image OpenCV takes a tenth of the time of NumPy's sums over the whole batch.
    sampled = np.ascontiguousarray(color[:, ::_EVERY, ::_EVERY])
    statistics = np.array([cv2.meanStdDev(image) for image in sampled])  # (B, 2, 3, 1)
    return _shows_nothing(statistics[:, 0, :, 0], statistics[:, 1, :, 0])


def _shows_nothing(mean: NDArray[np.float64], deviation: NDArray[np.float64]) -> Bool:
    """The same of images with these means and standard deviations (B, 3) of their colours."""
    brightness, spread = mean.mean(axis=1), deviation.max(axis=1)
    extreme = (brightness < _DARK) | (brightness > _BRIGHT)
    return (spread < _CONSTANT) | (extreme & (spread < _FAINT))


class InvalidFrameDetector(Saved):
    """Detects blank frames of B envs, in recordings that have colour.

    Recordings without colour have blank images from the first frame on.
    """

    saved = ("colorless",)

    def __init__(self, batch: int) -> None:
        self.colorless = np.zeros(batch, dtype=bool)
        self._survey = Surveyor(_EVERY)

    def find(self, frames: Images, started: Bool) -> Bool:
        """Which frames are blank (B,); the first of an env says whether it has colour.

        Raises:
            InputError: depth of frames on the device that is no depth; nothing has changed.
        """
        if frames.on_device:
            mean, deviation, is_bad = self._survey(frames)
            if is_bad.any():
                raise InputError(f"{BAD_DEPTH} (env {np.flatnonzero(is_bad)[0]})")
            blank = _shows_nothing(mean, deviation)
        else:
            blank = is_invalid_frame(frames.color)
        self.colorless = np.where(started, self.colorless, blank)
        return blank & ~self.colorless
