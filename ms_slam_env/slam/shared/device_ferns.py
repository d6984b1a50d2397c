"""Ferns of frames that lie on the device: the codes of the host, bit for bit.

``cv2.resize`` by a whole factor with ``INTER_AREA`` and ``cv2.GaussianBlur`` of 8-bit images are
defined in whole numbers; ``FernEncoder`` uses them on the host, and these kernels repeat their
arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int32, UInt8
from ms_slam_env._runtime.warp import HostDeviceBuffer
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.slam.shared.images import Images

_ONE = 256  # sum of the blur's weights


def blur_weights(blur_px: float) -> Int32:
    """Weights of OpenCV's Gaussian for 8-bit images, in 1/256; rounding errors are passed on."""
    size = int(np.rint(6.0 * blur_px + 1.0)) | 1
    exact = _ONE * cv2.getGaussianKernel(size, blur_px).ravel()
    weights, error = np.zeros(size, dtype=np.int32), 0.0
    for i in range(size // 2):
        weights[i] = weights[-1 - i] = np.rint(exact[i] + error)
        error += exact[i] - weights[i]
    weights[size // 2] = _ONE - weights.sum()
    return weights


@dataclass(frozen=True)
class FernTests:
    """Where and against what ``FernEncoder`` tests frames."""

    image: tuple[int, int]  # rows, columns of the frame
    reduced: tuple[int, int]  # rows, columns of the tested image
    step: int  # rows and columns of the frame that one of the thinned image stands for
    blur_px: float
    mean_level: float
    color_place: NDArray[np.int64]  # (F,) pixel of the tested image
    depth_place: NDArray[np.int64]  # (F,) pixel of the frame
    color_thresholds: Float64  # (F, 3)
    depth_thresholds: Float64  # (F,)

    @property
    def factor(self) -> int:
        """Rows and columns of the thinned image to one of the reduced; 0: no whole number."""
        thinned = [-(-length // self.step) for length in self.image]
        factors = {long / short for long, short in zip(thinned, self.reduced, strict=True)}
        whole = {int(factor) for factor in factors if factor == int(factor)}
        return whole.pop() if len(factors) == 1 and whole else 0

    @property
    def run_on_device(self) -> bool:
        """Whether the kernels can take the tests: frames are a whole number of times as large."""
        return self.factor > 0 and len(blur_weights(self.blur_px)) // 2 < min(self.reduced)


@wp.kernel
def _reduce(
    color: wp.array[wp.uint8],  # (B * H * W * 3)
    envs: wp.array[wp.int32],  # (N,)
    height: wp.int32,
    width: wp.int32,
    step: wp.int32,
    factor: wp.int32,
    per_area: wp.float32,
    reduced: wp.array4d[wp.uint8],  # (N, rows, columns, 3)
) -> None:
    """Mean of ``factor`` x ``factor`` pixels of every ``step``-th row and column."""
    n, row, column = wp.tid()
    first = (envs[n] * height + row * factor * step) * width + column * factor * step
    for channel in range(3):
        total = wp.int32(0)
        for i in range(factor):
            for j in range(factor):
                total += wp.int32(color[3 * (first + (i * width + j) * step) + channel])
        mean = (total + 2) / 4
        if factor != 2:
            mean = wp.int32(wp.rint(wp.float32(total) * per_area))
        reduced[n, row, column, channel] = wp.uint8(mean)


@wp.func
def _mirrored(i: int, size: int) -> int:
    """Place of an element beyond the border, which is mirrored at the outermost one."""
    inside = wp.abs(i)
    return wp.where(inside < size, inside, 2 * size - 2 - inside)


@wp.kernel
def _blur_rows(
    image: wp.array4d[wp.uint8], weights: wp.array[wp.int32], blurred: wp.array4d[wp.int32]
) -> None:
    """Blur a row along itself, in 1/256."""
    n, row = wp.tid()
    half = weights.shape[0] / 2
    for column in range(image.shape[2]):
        for channel in range(3):
            total = wp.int32(0)
            for k in range(weights.shape[0]):
                at = _mirrored(column + k - half, image.shape[2])
                total += weights[k] * wp.int32(image[n, row, at, channel])
            blurred[n, row, column, channel] = total


@wp.kernel
def _blur_columns(
    image: wp.array4d[wp.int32],
    weights: wp.array[wp.int32],
    blurred: wp.array4d[wp.uint8],
    sums: wp.array[wp.int32],  # (N,) of all values
) -> None:
    """Blur a row of ``_blur_rows`` across, and round."""
    n, row = wp.tid()
    half = weights.shape[0] / 2
    brightness = wp.int32(0)
    for column in range(image.shape[2]):
        for channel in range(3):
            total = wp.int32(32768)
            for k in range(weights.shape[0]):
                at = _mirrored(row + k - half, image.shape[1])
                total += weights[k] * image[n, at, column, channel]
            value = wp.min(total / 65536, 255)
            blurred[n, row, column, channel] = wp.uint8(value)
            brightness += value
    wp.atomic_add(sums, n, brightness)


@wp.kernel
def _test(
    image: wp.array2d[wp.uint8],  # (N, rows * columns * 3)
    sums: wp.array[wp.int32],
    depth: wp.array2d[wp.float32],  # (B, H * W)
    envs: wp.array[wp.int32],
    color_place: wp.array[wp.int64],
    depth_place: wp.array[wp.int64],
    color_thresholds: wp.array2d[wp.float64],
    depth_thresholds: wp.array[wp.float64],
    mean_level: wp.float64,
    bits: wp.array2d[wp.uint8],  # (N, F)
    known: wp.array2d[wp.uint8],
) -> None:
    """The four tests of a fern."""
    n, fern = wp.tid()
    mean = wp.float64(sums[n]) / wp.float64(image.shape[1])
    relative = wp.max(mean, wp.float64(1.0)) / mean_level
    found = wp.int32(0)
    place = 3 * wp.int32(color_place[fern])
    for channel in range(3):
        limit = color_thresholds[fern, channel] * relative
        if wp.float64(image[n, place + channel]) > limit:
            found += 1 << channel
    reading = depth[envs[n], wp.int32(depth_place[fern])]
    if wp.float64(reading) > depth_thresholds[fern]:
        found += 8
    bits[n, fern] = wp.uint8(found)
    known[n, fern] = wp.uint8(wp.where(reading > 0.0, 15, 7))


class DeviceFernEncoder:
    """Encodes frames of B envs where they lie."""

    def __init__(self, tests: FernTests, batch: int, device: str) -> None:
        self.tests, self.batch, self.device = tests, batch, device
        size = (batch, *tests.reduced, 3)
        ferns = len(tests.depth_place)
        self._reduced = wp.empty(size, dtype=wp.uint8, device=device)
        self._blurred = wp.empty(size, dtype=wp.int32, device=device)
        self._envs = HostDeviceBuffer(batch, wp.int32, device)
        self._sums = HostDeviceBuffer(batch, wp.int32, device)
        self._bits = HostDeviceBuffer((batch, ferns), wp.uint8, device)
        self._known = HostDeviceBuffer((batch, ferns), wp.uint8, device)
        self._weights = wp.array(blur_weights(tests.blur_px), dtype=wp.int32, device=device)
        self._places = [
            wp.array(place, dtype=wp.int64, device=device)
            for place in (tests.color_place, tests.depth_place)
        ]
        self._thresholds = [
            wp.array(thresholds, dtype=wp.float64, device=device)
            for thresholds in (tests.color_thresholds, tests.depth_thresholds)
        ]

    def encode(self, images: Images, envs: Int32) -> tuple[UInt8, UInt8]:
        """Bits and known bits (N, F) of the frames of the ``envs`` (N,)."""
        tests, count, rows = self.tests, len(envs), self.tests.reduced[0]
        self._envs.write(np.concatenate([envs, np.zeros(self.batch - count, dtype=np.int32)]))
        self._sums.zero()
        sampling = [*tests.image, tests.step, tests.factor]
        per_area = np.float32(1) / np.float32(tests.factor**2)
        flat = [images.color.flatten(), self._envs.array]
        which, image = [self._envs.array, *self._places, *self._thresholds], self._reduced
        tested = [image.reshape((self.batch, -1)), self._sums.array]
        tested += [images.depth.reshape((self.batch, -1)), *which, tests.mean_level]
        found = [self._bits.array, self._known.array]
        ferns = len(tests.depth_place)
        for kernel, dim, inputs in (
            (_reduce, (count, *tests.reduced), [*flat, *sampling, per_area, image]),
            (_blur_rows, (count, rows), [image, self._weights, self._blurred]),
            (_blur_columns, (count, rows), [self._blurred, self._weights, image, tested[1]]),
            (_test, (count, ferns), [*tested, *found]),
        ):
            wp.launch(kernel, dim, inputs, device=self.device)
        return self._bits.look()[:count].copy(), self._known.look()[:count].copy()
