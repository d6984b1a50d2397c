"""From sensor images to filtered depth, vertices, normals and intensity, for B envs at once.

ElasticFusion (Whelan et al., RSS 2015) section III: depth is filtered bilaterally. Here the
filter runs along columns, then rows (Pham and van Vliet, ICME 2005), and on inverse depth, because
the inverse depth of a plane is linear in the image (so a symmetric window keeps planes) and the
noise of a structured-light sensor is uniform in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import RecordedLaunch, wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.slam.surfel.device import HostDeviceBuffer, fetch, put, threads_per_row
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

FLATTEST = wp.constant(5.67)  # tangent of 80 degrees, of the view onto a plane close by


@dataclass(frozen=True)
class LiveFrame:
    """The sensor's frames of B envs after preprocessing, on the device."""

    raw_depth: wp.array  # (B, H, W) float32 metres as sensed; 0 = no reading or beyond the cutoff
    depth: wp.array  # (B, H, W) float32 metres, bilaterally filtered and cut off; 0 = no reading
    vertices: wp.array  # (B, H, W) vec3 back-projected ``depth``, camera frame; z = 0 where invalid
    # (B, H, W) vec3 unit normals, camera frame, towards the camera; 0 where invalid.
    normals: wp.array
    color: wp.array  # (B, H, W) vec3 RGB in [0, 255]
    intensity: wp.array  # (B, H, W) float32 in [0, 255] (BT.601 luma of ``color``)
    moving: wp.array  # (B, H, W) int32, 1 where the motion mask says that something moves


@wp.kernel
def _convert(
    raw_depth: wp.array(dtype=wp.float32),
    raw_color: wp.array(dtype=wp.uint8),
    cutoff_m: wp.float32,
    width: wp.int32,
    columns: wp.int32,  # per thread
    inverse_depth: wp.array(dtype=wp.float32),
    color: wp.array(dtype=wp.vec3),
    intensity: wp.array(dtype=wp.float32),
):
    """Inverse depth (0 for no reading or one beyond the cutoff), colour and its BT.601 luma."""
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
    inverse_depth: wp.array(dtype=wp.float32),
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,
    along_rows: wp.int32,  # 1: neighbours are in the same row; 0: in the same column
    spatial_weights: wp.array(dtype=wp.float32),  # (radius + 1,)
    per_cutoff_squared: wp.float32,  # 1 / (difference of inverse depth that weighs nothing)^2
    weights: wp.array(dtype=wp.float32),  # working memory, per pixel
    shifts: wp.array(dtype=wp.float32),
    filtered: wp.array(dtype=wp.float32),
):
    """Bilateral filter along the rows or the columns of the image.

    The loop over neighbours is outside, the one over pixels inside and without branches: the
    compiler turns it into operations on many pixels at once.
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
def _slope(before: float, here: float, after: float, largest: float, steepest: float):
    """Difference per step of inverse depth to valid neighbours; (slope, 1), or (0, 0) if none.

    Inputs are inverse depths, 0 where invalid. A side that jumps by more than ``largest`` is an
    edge, unless both sides continue one plane that is seen no flatter than ``steepest``: up close
    the inverse depth of a tilted plane changes as much from pixel to pixel, all over it.
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
):
    """Unit normal of a pixel from its inverse depth and its neighbours'; 0 where invalid."""
    slope_u = _slope(left, inverse, right, largest, FLATTEST / focal_per_step[0])
    slope_v = _slope(above, inverse, below, largest, FLATTEST / focal_per_step[1])
    # On a plane n . p = d, inverse depth is n . ray / d, linear in the ray's x and y:
    # its gradient there, and its value at ray (0, 0, 1), are the normal up to scale.
    a = slope_u[0] * focal_per_step[0]
    c = slope_v[0] * focal_per_step[1]
    normal = wp.vec3(a, c, inverse - a * ray[0] - c * ray[1])
    squared = wp.dot(normal, normal)
    valid = inverse > 0.0 and slope_u[1] * slope_v[1] > 0.0 and squared > 0.0
    return wp.where(valid, -1.0 / wp.sqrt(wp.where(valid, squared, 1.0)), 0.0) * normal


@wp.kernel
def _surface(
    inverse_depth: wp.array(dtype=wp.float32),
    height: wp.int32,
    width: wp.int32,
    columns: wp.int32,
    step: wp.int32,
    largest: wp.float32,
    focal: wp.vec2,
    centre: wp.vec2,
    depth: wp.array(dtype=wp.float32),
    vertices: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
):
    """Depth, vertices and normals of filtered inverse depth."""
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
        self._raw_color = HostDeviceBuffer((*shape, 3), wp.uint8, device)
        self._raw_depth = HostDeviceBuffer(shape, wp.float32, device)
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
        weights = np.exp(-(offsets**2) / (2 * config.bilateral_sigma_px**2))
        self._spatial_weights = wp.array(weights, dtype=wp.float32, device=device)
        # A finer image has noisier slopes over one pixel; keep the baseline of 160 columns.
        self._normal_step = max(1, intrinsics.width // 160)
        self._columns, threads = threads_per_row(intrinsics.width, device)
        self._dim = (batch * intrinsics.height, threads)
        self._stages = self._record()

    def __call__(self, color: NDArray[np.uint8], depth: NDArray[np.float32]) -> LiveFrame:
        """Preprocess colour (B, H, W, 3) uint8 and depth (B, H, W) float32 m into one LiveFrame.

        The frame's buffers are those of the last call.
        """
        check_images(color, depth, self._raw_depth.array.shape)
        self._raw_color.write(color)
        self._raw_depth.write(depth)
        for launch in self._stages:
            launch.launch()
        return self.frame

    def _record(self) -> list[RecordedLaunch]:
        """The stages; all buffers stay."""
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


def check_images(
    color: NDArray[np.uint8], depth: NDArray[np.float32], size: tuple[int, ...]
) -> None:
    """Refuse another ``size`` than (B, H, W), and depth that is no depth."""
    if color.shape != (*size, 3) or depth.shape != size:
        raise InputError(
            f"colour {color.shape} and depth {depth.shape} must be {(*size, 3)} and {size}"
        )
    if not (depth.min() >= 0 and depth.max() < np.inf):
        raise InputError("depth holds NaN, infinite or negative values; 0 means no reading")
