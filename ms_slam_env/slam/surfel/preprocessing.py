"""Turn sensor images into filtered depth, vertices, normals and intensity, for B envs at once.

ElasticFusion (Whelan et al., RSS 2015) section III: depth is filtered bilaterally. Here the
filter runs along columns, then rows (Pham and van Vliet, ICME 2005), and on inverse depth, because
the inverse depth of a plane is linear in the image (so a symmetric window keeps planes) and the
noise of a structured-light sensor is uniform in it.

Invalid pixels do not affect the coarser levels of vertices, normals and intensity. Averaging over
an invalid pixel, or across a depth edge, would make points and grey values that do not exist and
break tracking at the coarse levels. A coarse pixel is the mean of those valid pixels of its 2x2
block that lie near the front-most of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float32
from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.slam.surfel.device import SavedBuffer, fetch, put, threads_per_row
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

SIGMA_PX = 1.5  # width of the bilateral depth filter in the image
FLATTEST = wp.constant(5.67)  # tangent of 80 degrees, of the view onto a plane close by


@dataclass(frozen=True)
class LiveFrame:
    """The sensor's frames of B envs after preprocessing, on the device."""

    raw_depth: wp.array  # (B, H, W) float32 metres as sensed; 0 = no reading
    depth: wp.array  # (B, H, W) float32 metres, bilaterally filtered and cut off; 0 = no reading
    vertices: wp.array  # (B, H, W) vec3 back-projected ``depth``, camera frame; z = 0 where invalid
    # (B, H, W) vec3 unit normals, camera frame, towards the camera; 0 where invalid.
    normals: wp.array
    color: wp.array  # (B, H, W) vec3 RGB in [0, 255]
    intensity: wp.array  # (B, H, W) float32 in [0, 255] (BT.601 luma of ``color``)
    moving: wp.array  # (B, H, W) int32, 1 where the motion mask marks something moving


@wp.kernel
def _convert(
    raw_depth: wp.array[wp.float32],
    raw_color: wp.array[wp.uint8],
    cutoff_m: wp.float32,
    width: wp.int32,
    columns: wp.int32,  # per thread
    inverse_depth: wp.array[wp.float32],
    color: wp.array[wp.vec3],
    intensity: wp.array[wp.float32],
) -> None:
    """Compute inverse depth (0: no reading, or beyond the cutoff), colour and BT.601 luma."""
    row, piece = wp.tid()
    i = row * width + piece * columns
    end = row * width + wp.min((piece + 1) * columns, width)
    while i < end:
        z = fetch(raw_depth, i)
        valid = z > 0.0 and z <= cutoff_m
        put(inverse_depth, i, wp.where(valid, 1.0 / wp.where(valid, z, 1.0), 0.0))
        red = wp.float32(fetch(raw_color, 3 * i))
        green = wp.float32(fetch(raw_color, 3 * i + 1))
        blue = wp.float32(fetch(raw_color, 3 * i + 2))
        put(color, i, wp.vec3(red, green, blue))
        put(intensity, i, 0.299 * red + 0.587 * green + 0.114 * blue)
        i += 1


@wp.kernel
def _filter(
    inverse_depth: wp.array[wp.float32],
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,
    along_rows: wp.int32,  # 1: neighbours are in the same row; 0: in the same column
    spatial_weights: wp.array[wp.float32],  # (radius + 1,)
    per_cutoff_squared: wp.float32,  # 1 / (difference of inverse depth with zero weight)^2
    weights: wp.array[wp.float32],  # working memory, per pixel
    shifts: wp.array[wp.float32],
    filtered: wp.array[wp.float32],
) -> None:
    """Bilateral filter along the rows or the columns of the image.

    The outer loop runs over neighbours; the inner loop runs over pixels and has no branches, so the
    compiler vectorizes it.
    """
    row, piece = wp.tid()
    v = row % height
    radius = spatial_weights.shape[0] - 1
    start = row * width
    first = piece * columns
    last = wp.min((piece + 1) * columns, width)
    i = start + first
    while i < start + last:
        put(weights, i, fetch(spatial_weights, 0))
        put(shifts, i, 0.0)
        i += 1
    for offset in range(-radius, radius + 1):
        spatial = fetch(spatial_weights, wp.abs(offset))
        i = start + first
        end = start + last
        to_near = offset * width
        if along_rows != 0:
            i = start + wp.max(first, -offset)
            end = start + wp.min(last, width - offset)
            to_near = offset
        elif v + offset < 0 or v + offset >= height:
            end = i
        if offset == 0:
            end = i
        while i < end:
            near = fetch(inverse_depth, i + to_near)
            difference = near - fetch(inverse_depth, i)
            # Tukey's bisquare has the curvature of the Gaussian at 0 and needs no exp().
            closeness = wp.max(1.0 - difference * difference * per_cutoff_squared, 0.0)
            weight = wp.where(near > 0.0, spatial * closeness * closeness, 0.0)
            put(weights, i, fetch(weights, i) + weight)
            put(shifts, i, fetch(shifts, i) + weight * difference)
            i += 1
    i = start + first
    while i < start + last:
        centre = fetch(inverse_depth, i)
        mean = centre + fetch(shifts, i) / fetch(weights, i)
        put(filtered, i, wp.where(centre > 0.0, mean, 0.0))
        i += 1


@wp.func
def _slope(before: float, here: float, after: float, largest: float, steepest: float) -> wp.vec2:
    """Slope of inverse depth per step to valid neighbours: (slope, 1), or (0, 0) without any.

    Inputs are inverse depths, 0 where invalid. A side that jumps by more than ``largest`` is an
    edge, unless both sides lie on one plane whose slope is within ``steepest``: up close, the
    inverse depth of a tilted plane changes that much from pixel to pixel everywhere.
    """
    difference = after - here
    difference_back = here - before
    is_even = wp.abs(difference - difference_back) <= 0.5 * largest
    is_seen = wp.abs(difference + difference_back) <= 2.0 * steepest * here
    on_plane = before > 0.0 and after > 0.0 and is_even and is_seen
    forth = wp.where(after > 0.0 and (wp.abs(difference) <= largest or on_plane), 1.0, 0.0)
    back = wp.where(before > 0.0 and (wp.abs(difference_back) <= largest or on_plane), 1.0, 0.0)
    count = forth + back
    total = forth * difference + back * difference_back
    return wp.vec2(total / wp.max(count, 1.0), wp.min(count, 1.0))


@wp.func
def _normal(
    left: float,
    right: float,
    above: float,
    below: float,
    inverse: float,
    largest: float,
    ray: wp.vec2,
    focal_per_step: wp.vec2,
) -> wp.vec3:
    """Unit normal of a pixel from its inverse depth and its neighbours'; 0 where invalid."""
    slope_u = _slope(left, inverse, right, largest, FLATTEST / focal_per_step[0])
    slope_v = _slope(above, inverse, below, largest, FLATTEST / focal_per_step[1])
    # On a plane n . p = d, inverse depth is n . ray / d, linear in the ray's x and y. Its gradient,
    # and its value at ray (0, 0, 1), are the normal up to scale.
    a = slope_u[0] * focal_per_step[0]
    c = slope_v[0] * focal_per_step[1]
    normal = wp.vec3(a, c, inverse - a * ray[0] - c * ray[1])
    squared = wp.dot(normal, normal)
    valid = inverse > 0.0 and slope_u[1] * slope_v[1] > 0.0 and squared > 0.0
    return wp.where(valid, -1.0 / wp.sqrt(wp.where(valid, squared, 1.0)), 0.0) * normal


@wp.kernel
def _surface(
    inverse_depth: wp.array[wp.float32],
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,
    step: wp.int32,
    largest: wp.float32,
    focal: wp.vec2,
    centre: wp.vec2,
    depth: wp.array[wp.float32],
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
) -> None:
    """Compute depth, vertices and normals from filtered inverse depth."""
    row, piece = wp.tid()
    v = row % height
    start = row * width
    first = piece * columns
    last = wp.min((piece + 1) * columns, width)
    per_focal = 1.0 / focal[0]
    y = (wp.float32(v) - centre[1]) / focal[1]
    i = start + first
    while i < start + last:
        inverse = fetch(inverse_depth, i)
        z = wp.where(inverse > 0.0, 1.0 / wp.where(inverse > 0.0, inverse, 1.0), 0.0)
        put(depth, i, z)
        put(vertices, i, wp.vec3(z * (wp.float32(i - start) - centre[0]) * per_focal, z * y, z))
        i += 1
    focal_per_step = focal / wp.float32(step)
    has_above = wp.where(v >= step, 1.0, 0.0)  # outside the image the inverse depth counts as 0
    has_below = wp.where(v + step < height, 1.0, 0.0)
    to_above = wp.where(v >= step, -step * width, 0)
    to_below = wp.where(v + step < height, step * width, 0)
    for part in range(3):  # the columns near the left border, those inside, those near the right
        i = start + wp.max(first, wp.where(part == 0, 0, wp.where(part == 1, step, width - step)))
        end = start + wp.min(
            last, wp.where(part == 0, step, wp.where(part == 1, width - step, width))
        )
        has_left = wp.where(part == 0, 0.0, 1.0)
        has_right = wp.where(part == 2, 0.0, 1.0)
        to_left = wp.where(part == 0, 0, -step)
        to_right = wp.where(part == 2, 0, step)
        while i < end:
            ray = wp.vec2((wp.float32(i - start) - centre[0]) * per_focal, y)
            normal = _normal(
                has_left * fetch(inverse_depth, i + to_left),
                has_right * fetch(inverse_depth, i + to_right),
                has_above * fetch(inverse_depth, i + to_above),
                has_below * fetch(inverse_depth, i + to_below),
                fetch(inverse_depth, i),
                largest,
                ray,
                focal_per_step,
            )
            put(normals, i, normal)
            i += 1


class Preprocessor:
    """Owns the device buffers of the live frames and fills them."""

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str = "cpu"
    ) -> None:
        intrinsics.check_pinhole("SLAM")
        self.intrinsics = intrinsics
        self.config = config
        self.device = device
        shape = (batch, *intrinsics.shape)
        self._raw_color = SavedBuffer((*shape, 3), wp.uint8, device)
        self._raw_depth = SavedBuffer(shape, wp.float32, device)
        self._inverse_depth = wp.zeros(shape, dtype=wp.float32, device=device)
        self.frame = LiveFrame(
            raw_depth=self._raw_depth.array,
            depth=wp.zeros(shape, dtype=wp.float32, device=device),
            vertices=wp.zeros(shape, dtype=wp.vec3, device=device),
            normals=wp.zeros(shape, dtype=wp.vec3, device=device),
            color=wp.zeros(shape, dtype=wp.vec3, device=device),
            intensity=wp.zeros(shape, dtype=wp.float32, device=device),
            moving=wp.zeros(shape, dtype=wp.int32, device=device),
        )
        self._filtered, self._weights, self._shifts = (
            wp.zeros_like(self._inverse_depth) for _ in range(3)
        )
        offsets = np.arange(config.bilateral_radius_px + 1, dtype=np.float32)
        weights = np.exp(-(offsets**2) / (2 * SIGMA_PX**2))
        self._spatial_weights = wp.array(weights, dtype=wp.float32, device=device)
        # A finer image has noisier slopes over one pixel; keep the baseline of 160 columns.
        self._normal_step = max(1, intrinsics.width // 160)
        self._columns, threads = threads_per_row(intrinsics.width, device)
        self._dim = (batch * intrinsics.height, threads)
        self._stages = self._record()

    def __call__(self, color: Any, depth: Any) -> LiveFrame:
        """Preprocess colour (B, H, W, 3) uint8 and depth (B, H, W) float32 m into one LiveFrame.

        Images are NumPy arrays or lie on the device, see ``Images``; of those depth is not looked
        at for values that are none: they count as no reading. The frame's buffers are those of the
        last call.
        """
        check_images(color, depth, self._raw_depth.array.shape)
        self._raw_color.write(color)
        self._raw_depth.write(depth)
        for launch in self._stages:
            launch.launch()
        return self.frame

    def _record(self) -> list[RecordedLaunch]:
        """Record the launches of all stages; they use the same buffers every time."""
        frame, config, camera, dim = self.frame, self.config, self.intrinsics, self._dim
        size = [camera.height, camera.width, self._columns]
        inverse, filtered = self._inverse_depth.flatten(), self._filtered.flatten()
        sensed = [frame.raw_depth.flatten(), self._raw_color.array.flatten()]
        color = [frame.color.flatten(), frame.intensity.flatten()]
        per_cutoff_squared = 1.0 / (2.0 * config.bilateral_sigma_m) ** 2
        rule = [self._spatial_weights, per_cutoff_squared]
        working = [self._weights.flatten(), self._shifts.flatten()]
        edge = config.normal_edge_per_m * self._normal_step * 160 / camera.width
        pinhole = [wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)]
        surface = [frame.depth.flatten(), frame.vertices.flatten(), frame.normals.flatten()]
        stages = [
            (_convert, [*sensed, config.depth_cutoff_m, *size[1:], inverse, *color]),
            (_filter, [inverse, *size, 0, *rule, *working, filtered]),
            (_filter, [filtered, *size, 1, *rule, *working, inverse]),
            (_surface, [inverse, *size, self._normal_step, edge, *pinhole, *surface]),
        ]
        return [RecordedLaunch(kernel, dim, inputs, self.device) for kernel, inputs in stages]


@wp.kernel
def _count_readings(
    depth: wp.array[wp.float32],
    height: wp.int32,
    width: wp.int32,
    counts: wp.array[wp.int32],  # (B,)
) -> None:
    """Count the pixels that have depth, a row a thread."""
    row = wp.tid()
    found = wp.int32(0)
    i = row * width
    while i < (row + 1) * width:
        found += wp.where(fetch(depth, i) > 0.0, 1, 0)
        i += 1
    wp.atomic_add(counts, row / height, found)


def count_readings(live: LiveFrame) -> NDArray[np.int32]:
    """Pixels (B,) of the frames that have depth."""
    batch, height, width = live.depth.shape
    counts = wp.zeros(batch, dtype=wp.int32, device=live.depth.device)
    inputs = [live.depth.flatten(), height, width, counts]
    wp.launch(_count_readings, batch * height, inputs, device=live.depth.device)
    return np.asarray(counts.numpy())


BAD_DEPTH = "depth holds NaN, infinite or negative values; 0 means no reading"


def check_images(color: Any, depth: Any, size: tuple[int, ...]) -> None:
    """Refuse another ``size`` than (B, H, W), and on the host depth that is no depth."""
    if tuple(color.shape) != (*size, 3) or tuple(depth.shape) != size:
        raise InputError(
            f"colour {color.shape} and depth {depth.shape} must be {(*size, 3)} and {size}"
        )
    if isinstance(depth, np.ndarray) and not (depth.min() >= 0 and depth.max() < np.inf):
        raise InputError(BAD_DEPTH)


EDGE_FRACTION = 0.03  # of depth; pixels further behind a block's front one are another surface


@wp.func
def _share(p: wp.vec3, limit: float) -> float:
    """Return 1 for a valid pixel that is not behind the limit, else 0."""
    return wp.where(p[2] > 0.0 and p[2] <= limit, 1.0, 0.0)


@wp.func
def _distance(p: wp.vec3) -> float:
    """Depth of a pixel; a very large value if invalid."""
    return wp.where(p[2] > 0.0, p[2], 1.0e9)


@wp.kernel
def _downsample(
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    intensity: wp.array[wp.float32],
    height: wp.int32,  # of the fine image
    width: wp.int32,
    edge_fraction: wp.float32,
    columns: wp.int32,  # of the coarse image, per thread
    coarse_vertices: wp.array[wp.vec3],
    coarse_normals: wp.array[wp.vec3],
    coarse_intensity: wp.array[wp.float32],
) -> None:
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
        # The sensor's grey value is valid even where its depth is missing.
        mean = 0.25 * (i00 + i01 + i10 + i11)
        put(coarse_intensity, i, wp.where(count > 0.0, grey, mean))
        u += 1
        i += 1
        j += 2


@wp.kernel
def _intensity_gradient(
    intensity: wp.array[wp.float32],
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,
    gradient: wp.array[wp.vec3],
) -> None:
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
    """One pyramid level; arrays (B, h, w). ``gradient`` holds (I, dI/du, dI/dv), or is empty."""

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
        """All levels of images (B, H, W), finest first; overwrites earlier coarse levels."""
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
        """Threads of a kernel that writes ``image`` (B, h, w), each a piece of a row."""
        batch, height, width = image.shape
        return batch * height, -(-width // self._columns)


_FROM = {0: np.s_[:-1, :], 1: np.s_[:, :-1]}  # pixels with a neighbour below, or to the right
_TO = {0: np.s_[1:, :], 1: np.s_[:, 1:]}


class Pieces:
    """Connected pieces of a depth image, cut at steps of inverse depth and at creases.

    Attributes:
        labels: (h, w) label of the piece; 0 on seams.
        count: number of labels, 0 included.
    """

    def __init__(
        self, depth: Float32, normals: Float32, largest_step: float, least_cosine: float
    ) -> None:
        """Cut the image.

        Args:
            depth: (h, w) metres, 0 = no reading.
            normals: (h, w, 3) unit vectors; 0 = none.
            largest_step: largest step of inverse depth within a piece, between neighbours, 1/m.
            least_cosine: least cosine of the angle between their normals.
        """
        is_inner = depth > 0
        inverse = np.where(is_inner, 1.0 / np.where(is_inner, depth, 1.0), -np.inf)
        for axis in (0, 1):
            a, b = _FROM[axis], _TO[axis]
            is_joined = np.abs(inverse[a] - np.maximum(inverse[b], -1e6)) < largest_step
            cosine = np.einsum("hwc,hwc->hw", normals[a], normals[b])
            is_inner[a] &= is_joined & (cosine > least_cosine)
        count, labels = cv2.connectedComponents(is_inner.astype(np.uint8), connectivity=4)
        self.count, self.labels = count, np.asarray(labels)

    def number(self, where: Bool) -> NDArray[np.int64]:
        """Number (count,) of pixels of each piece that are set in ``where`` (h, w)."""
        return np.bincount(self.labels[where], minlength=self.count)

    def where(self, votes: Bool, against: Bool, share: float, least: NDArray[np.float64]) -> Bool:
        """Pixels (h, w) of the pieces that win the vote.

        Args:
            votes: (h, w) pixels for.
            against: (h, w) pixels against, unless they are in ``votes``.
            share: the share for must be larger than this.
            least: (count,) the number for must be larger than this.
        """
        own, others = self.number(votes), self.number(against & ~votes)
        chosen = (own > share * (own + others)) & (own > least)
        chosen[0] = False
        return chosen[self.labels]

    def filled(self, values: Float32, limit: float) -> Float32:
        """Raise values (h, w) of pieces mostly above a limit to the mean of those above it.

        "Mostly" is more than half of the pixels. So a part that comes into view is treated like the
        rest of its object.
        """
        is_above = values > limit
        above, all_pixels = self.number(is_above), np.bincount(self.labels.ravel())
        weights = np.where(is_above, values, 0.0).ravel()
        mean = np.bincount(self.labels.ravel(), weights) / np.maximum(above, 1)
        mean[(above <= 0.5 * all_pixels) | (np.arange(self.count) == 0)] = -np.inf
        return np.maximum(values, mean[self.labels]).astype(np.float32)
