"""From sensor images to filtered depth, vertices, normals and intensity, for B envs at once.

ElasticFusion (Whelan et al., RSS 2015) section III: depth is filtered bilaterally. Here the
filter runs along columns, then rows (Pham and van Vliet, ICME 2005), and on inverse depth, because
the inverse depth of a plane is linear in the image (so a symmetric window keeps planes) and the
noise of a structured-light sensor is uniform in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.launches import Launches
from ms_slam_env.slam.surfel.types import LiveFrame


@wp.kernel
def _convert(
    raw_depth: wp.array3d(dtype=wp.float32),
    raw_color: wp.array4d(dtype=wp.uint8),
    cutoff_m: wp.float32,
    columns: wp.int32,  # per thread
    inverse_depth: wp.array3d(dtype=wp.float32),
    color: wp.array3d(dtype=wp.vec3),
    intensity: wp.array3d(dtype=wp.float32),
):
    """Inverse depth (0 for no reading or one beyond the cutoff), colour and its BT.601 luma."""
    b, v, piece = wp.tid()
    for u in range(piece * columns, wp.min((piece + 1) * columns, raw_depth.shape[2])):
        z = raw_depth[b, v, u]
        inverse = wp.float32(0.0)
        if z > 0.0 and z <= cutoff_m:
            inverse = 1.0 / z
        inverse_depth[b, v, u] = inverse
        red = wp.float32(raw_color[b, v, u, 0])
        green = wp.float32(raw_color[b, v, u, 1])
        blue = wp.float32(raw_color[b, v, u, 2])
        color[b, v, u] = wp.vec3(red, green, blue)
        intensity[b, v, u] = 0.299 * red + 0.587 * green + 0.114 * blue


@wp.func
def _weigh(near: float, centre: float, spatial: float, per_cutoff_squared: float):
    """Weight of a neighbour and its weighted difference; without a branch, which would be guessed
    wrongly at every second noisy pixel.
    """
    difference = near - centre
    # Tukey's bisquare has the curvature of the Gaussian at 0 and needs no exp().
    closeness = wp.max(1.0 - difference * difference * per_cutoff_squared, 0.0)
    weight = wp.where(near > 0.0, spatial * closeness * closeness, 0.0)
    return wp.vec2(weight, weight * difference)


@wp.kernel
def _filter_columns(
    inverse_depth: wp.array3d(dtype=wp.float32),
    spatial_weights: wp.array(dtype=wp.float32),  # (radius + 1,)
    per_cutoff_squared: wp.float32,  # 1 / (difference of inverse depth that weighs nothing)^2
    columns: wp.int32,
    filtered: wp.array3d(dtype=wp.float32),
):
    """Bilateral filter along the columns of the image."""
    b, v, piece = wp.tid()
    last = inverse_depth.shape[1] - 1
    radius = spatial_weights.shape[0] - 1
    for u in range(piece * columns, wp.min((piece + 1) * columns, inverse_depth.shape[2])):
        centre = inverse_depth[b, v, u]
        sums = wp.vec2(spatial_weights[0], 0.0)
        if centre > 0.0:
            for offset in range(wp.max(-radius, -v), 0):
                near = inverse_depth[b, v + offset, u]
                sums += _weigh(near, centre, spatial_weights[-offset], per_cutoff_squared)
            for offset in range(1, wp.min(radius, last - v) + 1):
                near = inverse_depth[b, v + offset, u]
                sums += _weigh(near, centre, spatial_weights[offset], per_cutoff_squared)
        filtered[b, v, u] = centre + sums[1] / sums[0]


@wp.kernel
def _filter_rows(
    inverse_depth: wp.array3d(dtype=wp.float32),
    spatial_weights: wp.array(dtype=wp.float32),
    per_cutoff_squared: wp.float32,
    columns: wp.int32,
    filtered: wp.array3d(dtype=wp.float32),
):
    """Bilateral filter along the rows of the image."""
    b, v, piece = wp.tid()
    last = inverse_depth.shape[2] - 1
    radius = spatial_weights.shape[0] - 1
    for u in range(piece * columns, wp.min((piece + 1) * columns, inverse_depth.shape[2])):
        centre = inverse_depth[b, v, u]
        sums = wp.vec2(spatial_weights[0], 0.0)
        if centre > 0.0:
            for offset in range(wp.max(-radius, -u), 0):
                near = inverse_depth[b, v, u + offset]
                sums += _weigh(near, centre, spatial_weights[-offset], per_cutoff_squared)
            for offset in range(1, wp.min(radius, last - u) + 1):
                near = inverse_depth[b, v, u + offset]
                sums += _weigh(near, centre, spatial_weights[offset], per_cutoff_squared)
        filtered[b, v, u] = centre + sums[1] / sums[0]


@wp.func
def _slope(before: float, here: float, after: float, largest: float):
    """Difference per step of inverse depth to valid neighbours; (slope, 1), or (0, 0) if none.

    Inputs are inverse depths, 0 where invalid. A side that jumps by more than ``largest`` is an
    edge.
    """
    forth = wp.where(after > 0.0 and wp.abs(after - here) <= largest, 1.0, 0.0)
    back = wp.where(before > 0.0 and wp.abs(here - before) <= largest, 1.0, 0.0)
    count = forth + back
    total = forth * (after - here) + back * (here - before)
    return wp.vec2(total / wp.max(count, 1.0), wp.min(count, 1.0))


@wp.kernel
def _surface(
    inverse_depth: wp.array3d(dtype=wp.float32),
    step: wp.int32,
    largest: wp.float32,
    focal: wp.vec2,
    centre: wp.vec2,
    columns: wp.int32,
    depth: wp.array3d(dtype=wp.float32),
    vertices: wp.array3d(dtype=wp.vec3),
    normals: wp.array3d(dtype=wp.vec3),
):
    """Depth, vertices and normals of filtered inverse depth."""
    b, v, piece = wp.tid()
    height = inverse_depth.shape[1]
    width = inverse_depth.shape[2]
    per_focal = 1.0 / focal[0]
    y = (wp.float32(v) - centre[1]) / focal[1]
    for u in range(piece * columns, wp.min((piece + 1) * columns, width)):
        inverse = inverse_depth[b, v, u]
        if inverse == 0.0:
            depth[b, v, u] = 0.0
            vertices[b, v, u] = wp.vec3(0.0, 0.0, 0.0)
            normals[b, v, u] = wp.vec3(0.0, 0.0, 0.0)
            continue
        z = 1.0 / inverse
        ray = wp.vec3((wp.float32(u) - centre[0]) * per_focal, y, 1.0)
        depth[b, v, u] = z
        vertices[b, v, u] = z * ray
        left = wp.float32(0.0)
        right = wp.float32(0.0)
        above = wp.float32(0.0)
        below = wp.float32(0.0)
        if u >= step:
            left = inverse_depth[b, v, u - step]
        if u + step < width:
            right = inverse_depth[b, v, u + step]
        if v >= step:
            above = inverse_depth[b, v - step, u]
        if v + step < height:
            below = inverse_depth[b, v + step, u]
        slope_u = _slope(left, inverse, right, largest)
        slope_v = _slope(above, inverse, below, largest)
        normal = wp.vec3(0.0, 0.0, 0.0)
        if slope_u[1] > 0.0 and slope_v[1] > 0.0:
            # On a plane n . p = d, inverse depth is n . ray / d, linear in the ray's x and y:
            # its gradient there, and its value at ray (0, 0, 1), are the normal up to scale.
            a = slope_u[0] * focal[0] / wp.float32(step)
            c = slope_v[0] * focal[1] / wp.float32(step)
            normal = -wp.normalize(wp.vec3(a, c, inverse - a * ray[0] - c * ray[1]))
        normals[b, v, u] = normal


def copy_in(target: wp.array, values: NDArray[Any]) -> None:
    """Copy values of the same shape into an array; ``assign`` costs four times as much on a CPU."""
    if target.device is not None and target.device.is_cpu:
        np.copyto(target.numpy(), values)
    else:
        target.assign(values)


class Preprocessor:
    """Owns the device buffers of the live frames and fills them."""

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str = "cpu"
    ) -> None:
        """Allocate for ``batch`` envs that share one camera model."""
        self.intrinsics = intrinsics
        self.config = config
        self.device = device
        shape = (batch, *intrinsics.shape)
        self._raw_color = wp.zeros((*shape, 3), dtype=wp.uint8, device=device)
        self._inverse_depth = wp.zeros(shape, dtype=wp.float32, device=device)
        self.frame = LiveFrame(
            raw_depth=wp.zeros(shape, dtype=wp.float32, device=device),
            depth=wp.zeros(shape, dtype=wp.float32, device=device),
            vertices=wp.zeros(shape, dtype=wp.vec3, device=device),
            normals=wp.zeros(shape, dtype=wp.vec3, device=device),
            color=wp.zeros(shape, dtype=wp.vec3, device=device),
            intensity=wp.zeros(shape, dtype=wp.float32, device=device),
        )
        self._filtered = [wp.zeros_like(self._inverse_depth) for _ in range(2)]
        offsets = np.arange(config.bilateral_radius_px + 1, dtype=np.float32)
        weights = np.exp(-(offsets**2) / (2 * config.bilateral_sigma_px**2))
        self._spatial_weights = wp.array(weights, dtype=wp.float32, device=device)
        # A finer image has noisier slopes over one pixel; keep the baseline of 160 columns.
        self._normal_step = max(1, intrinsics.width // 160)
        # The CPU runs one thread after another: whole rows. A GPU wants many threads.
        self._columns = 1 if wp.get_device(device).is_cuda else intrinsics.width
        self._launches = Launches(device)
        self._dim = (batch, intrinsics.height, -(-intrinsics.width // self._columns))

    def __call__(self, color: NDArray[np.uint8], depth: NDArray[np.float32]) -> LiveFrame:
        """Preprocess colour (B, H, W, 3) uint8 and depth (B, H, W) float32 m into one LiveFrame.

        The frame's buffers are those of the last call.
        """
        frame = self.frame
        copy_in(self._raw_color, color)
        copy_in(frame.raw_depth, depth)
        if not self._launches.replay("convert"):
            self._record()
            return frame
        for stage in ("filter columns", "filter rows", "surface"):
            self._launches.replay(stage)
        return frame

    def _record(self) -> None:
        """Run the stages for the first time and keep their launches: all buffers stay."""
        frame, config, camera, dim = self.frame, self.config, self.intrinsics, self._dim
        self._launches.record(
            "convert",
            _convert,
            dim,
            [frame.raw_depth, self._raw_color, config.depth_cutoff_m, self._columns],
            [self._inverse_depth, frame.color, frame.intensity],
        )
        per_cutoff_squared = 1.0 / (2.0 * config.bilateral_sigma_m) ** 2
        source = self._inverse_depth
        kernels = {"filter columns": _filter_columns, "filter rows": _filter_rows}
        for (name, kernel), target in zip(kernels.items(), self._filtered, strict=True):
            self._launches.record(
                name,
                kernel,
                dim,
                [source, self._spatial_weights, per_cutoff_squared, self._columns],
                [target],
            )
            source = target
        edge = config.normal_edge_per_m * self._normal_step * 160 / camera.width
        focal, centre = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
        self._launches.record(
            "surface",
            _surface,
            dim,
            [source, self._normal_step, edge, focal, centre, self._columns],
            [frame.depth, frame.vertices, frame.normals],
        )
