"""Coarser levels of vertices, normals and intensity in which invalid pixels leave no trace.

Averaging over an invalid pixel, or over a depth edge, makes points and grey values that exist
nowhere; they break tracking at the coarse levels. A coarse pixel is the mean of those pixels of
its 2x2 block that are valid and lie near the front-most of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from ms_slam_env._runtime.warp import RecordedLaunch, wp
from ms_slam_env.slam.surfel.device import fetch, put, threads_per_row

EDGE_FRACTION = 0.03  # pixels of a block further behind the front one than this are another surface


@wp.func
def _share(p: wp.vec3, limit: float):
    """1 for a valid pixel that is not behind the limit, else 0."""
    return wp.where(p[2] > 0.0 and p[2] <= limit, 1.0, 0.0)


@wp.func
def _distance(p: wp.vec3):
    """Depth of a pixel; very far where invalid."""
    return wp.where(p[2] > 0.0, p[2], 1.0e9)


@wp.kernel
def _downsample(
    vertices: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    intensity: wp.array(dtype=wp.float32),
    height: wp.int32,  # of the fine image
    width: wp.int32,
    edge_fraction: wp.float32,
    columns: wp.int32,  # of the coarse image, per thread
    coarse_vertices: wp.array(dtype=wp.vec3),
    coarse_normals: wp.array(dtype=wp.vec3),
    coarse_intensity: wp.array(dtype=wp.float32),
):
    row, piece = wp.tid()
    coarse_height = height / 2
    coarse_width = width / 2
    b = row / coarse_height
    u = piece * columns
    end = wp.min(u + columns, coarse_width)
    i = row * coarse_width + u  # in the coarse image
    j = (b * height + 2 * (row - b * coarse_height)) * width + 2 * u  # in the fine one
    while u < end:
        p00 = fetch(vertices, j)
        p01 = fetch(vertices, j + 1)
        p10 = fetch(vertices, j + width)
        p11 = fetch(vertices, j + width + 1)
        front = wp.min(
            wp.min(_distance(p00), _distance(p01)), wp.min(_distance(p10), _distance(p11))
        )
        limit = front * (1.0 + edge_fraction)
        s00 = _share(p00, limit)
        s01 = _share(p01, limit)
        s10 = _share(p10, limit)
        s11 = _share(p11, limit)
        normal = s00 * fetch(normals, j) + s01 * fetch(normals, j + 1)
        normal += s10 * fetch(normals, j + width) + s11 * fetch(normals, j + width + 1)
        i00 = fetch(intensity, j)
        i01 = fetch(intensity, j + 1)
        i10 = fetch(intensity, j + width)
        i11 = fetch(intensity, j + width + 1)
        count = s00 + s01 + s10 + s11
        per_count = 1.0 / wp.max(count, 1.0)
        grey = (s00 * i00 + s01 * i01 + s10 * i10 + s11 * i11) * per_count
        squared = wp.dot(normal, normal)
        has_normal = squared > 0.0
        scale = wp.where(has_normal, 1.0 / wp.sqrt(wp.where(has_normal, squared, 1.0)), 0.0)
        put(coarse_vertices, i, (s00 * p00 + s01 * p01 + s10 * p10 + s11 * p11) * per_count)
        put(coarse_normals, i, scale * normal)
        # The sensor's grey value is good where its depth is missing.
        mean = 0.25 * (i00 + i01 + i10 + i11)
        put(coarse_intensity, i, wp.where(count > 0.0, grey, mean))
        u += 1
        i += 1
        j += 2


@wp.kernel
def _intensity_gradient(
    intensity: wp.array(dtype=wp.float32),
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,
    gradient: wp.array(dtype=wp.vec3),
):
    """Write (intensity, d/du, d/dv) by central differences, one-sided at the border."""
    row, piece = wp.tid()
    v = row % height
    to_above = wp.where(v > 0, -width, 0)
    to_below = wp.where(v < height - 1, width, 0)
    per_height = wp.where(v > 0 and v < height - 1, 0.5, 1.0)
    start = row * width
    first = start + piece * columns
    last = start + wp.min((piece + 1) * columns, width)
    for part in range(3):  # the left border, the columns inside, the right border
        i = wp.max(first, start + wp.where(part == 0, 0, wp.where(part == 1, 1, width - 1)))
        end = start + wp.where(part == 0, 1, wp.where(part == 1, width - 1, width))
        end = wp.min(last, end)
        to_left = wp.where(part == 0, 0, -1)
        to_right = wp.where(part == 2, 0, 1)
        per_width = wp.where(part == 1, 0.5, 1.0)
        while i < end:
            slope_u = (fetch(intensity, i + to_right) - fetch(intensity, i + to_left)) * per_width
            slope_v = (fetch(intensity, i + to_below) - fetch(intensity, i + to_above)) * per_height
            put(gradient, i, wp.vec3(fetch(intensity, i), slope_u, slope_v))
            i += 1


@dataclass(frozen=True)
class Level:
    """One pyramid level; arrays (B, h, w). ``gradient`` holds (I, dI/du, dI/dv), or nothing."""

    vertices: wp.array
    normals: wp.array
    intensity: wp.array
    gradient: wp.array


class Pyramid:
    """Buffers of the coarse levels; level 0 is the caller's own images."""

    def __init__(
        self,
        batch: int,
        shapes: Sequence[tuple[int, int]],
        with_gradient: bool,
        device: str = "cpu",
    ) -> None:
        """Allocate for images of ``shapes`` (height, width), finest first.

        Raises:
            ValueError: a level is not half of the one before it, rounded down.
        """
        if any(coarse != (h // 2, w // 2) for (h, w), coarse in pairwise(shapes)):
            raise ValueError(f"levels must halve, rounded down: {list(shapes)}")
        self._device = device
        self._columns, _ = threads_per_row(shapes[0][1], device)
        self._launches: list[RecordedLaunch] = []
        self._levels: list[Level] = []

        self._with_gradient = with_gradient

        def image(dtype: Any) -> wp.array:
            return wp.zeros(size, dtype=dtype, device=device)

        def gradient() -> wp.array:
            return image(wp.vec3) if with_gradient else wp.empty(0, dtype=wp.vec3, device=device)

        size = (batch, *shapes[0])
        self._gradient = gradient()
        self._coarse: list[Level] = []
        for shape in shapes[1:]:
            size = (batch, *shape)
            images = image(wp.vec3), image(wp.vec3), image(wp.float32)
            self._coarse.append(Level(*images, gradient()))

    def build(self, vertices: wp.array, normals: wp.array, intensity: wp.array) -> list[Level]:
        """All levels, finest first, of images (B, H, W); the coarse ones overwrite the last."""
        if not self._levels or self._levels[0].vertices is not vertices:
            self._levels = [Level(vertices, normals, intensity, self._gradient), *self._coarse]
            self._launches = [self._downsampling(*pair) for pair in pairwise(self._levels)]
            if self._with_gradient:
                self._launches += [self._differentiation(level) for level in self._levels]
        for launch in self._launches:
            launch.launch()
        return self._levels

    def _downsampling(self, fine: Level, coarse: Level) -> RecordedLaunch:
        source = [fine.vertices.flatten(), fine.normals.flatten(), fine.intensity.flatten()]
        target = [coarse.vertices.flatten(), coarse.normals.flatten(), coarse.intensity.flatten()]
        size = fine.vertices.shape[1:]
        inputs = [*source, *size, EDGE_FRACTION, self._columns, *target]
        return RecordedLaunch(_downsample, self._dim(coarse.intensity), inputs, self._device)

    def _differentiation(self, level: Level) -> RecordedLaunch:
        size, image = level.intensity.shape[1:], level.intensity
        inputs = [image.flatten(), *size, self._columns, level.gradient.flatten()]
        return RecordedLaunch(_intensity_gradient, self._dim(image), inputs, self._device)

    def _dim(self, image: wp.array) -> tuple[int, int]:
        """Threads of a kernel that writes ``image`` (B, h, w): a piece of a row each."""
        batch, height, width = image.shape
        return batch * height, -(-width // self._columns)
